"""Differences from the reference, one line per row, with both intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from hudepth.metrics.catalogue import metric_info, metric_names
from hudepth.metrics.summary import Floats
from hudepth.report.ablation.estimates import BETTER, NOT_SHOWN, WORSE, Contrast, Interval
from hudepth.report.ablation.report import Report
from hudepth.viz.limits import usual_range
from hudepth.viz.style import BLUE, ORANGE, shorten, strip_frame

COLOURS = {BETTER: BLUE, WORSE: ORANGE, NOT_SHOWN: "0.45"}
OFFSET = 0.17  # from the middle of a row to its two intervals


def draw_effects(report: Report) -> Figure:
    """Draw one panel per metric: for each row that was paired with the reference, its difference and both intervals."""
    rows = [row for row in report.rows if row.contrasts]
    names = [*metric_names("headline", among=report.metrics), *metric_names("edge", among=report.metrics)[:1]]
    height = 1.35 + len(rows) * max(0.2, min(0.36, 14 / len(rows)))
    figure = Figure(figsize=(2.4 + 2.5 * len(names), height), dpi=130, layout="constrained")
    figure.suptitle(f"difference from {shorten(report.reference.label)}", fontsize=11)
    axes = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    for name, axis in zip(names, axes, strict=True):
        _panel(axis, {place: row.contrasts[name] for place, row in enumerate(rows) if name in row.contrasts})
        axis.set_title(metric_info(name).label, fontsize=10)
        axis.set_xlabel("better →" if metric_info(name).higher_is_better else "← better", fontsize=9)
        axis.tick_params(axis="x", labelsize=8)
        axis.tick_params(axis="y", length=0)
        axis.locator_params(axis="x", nbins=5)
        axis.grid(axis="x", alpha=0.25)
        axis.set_axisbelow(True)
        strip_frame(axis, "top", "right", "left")
    axes[0].set_yticks(range(len(rows)), [shorten(row.label) for row in rows], fontsize=9)
    axes[0].set_ylim(len(rows) - 0.45, -0.55)
    legend = [Line2D([], [], color=colour, marker="o", linewidth=0, label=word) for word, colour in COLOURS.items()]
    legend.append(Line2D([], [], color="0.45", linewidth=5, alpha=0.45, label="95 % over scenes"))
    legend.append(Line2D([], [], color="0.45", linewidth=1.2, marker="|", label="95 % over seeds"))
    figure.legend(handles=legend, loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def _panel(axis: Axes, found: Mapping[int, Contrast]) -> None:
    low, high = _limits(list(found.values()))
    axis.axvline(0, color="0.3", linewidth=0.9)
    axis.set_xlim(low, high)
    places, colours = np.array(list(found)), np.array([COLOURS[each.verdict] for each in found.values()])
    _intervals(axis, places - OFFSET / 2, [each.scenes for each in found.values()], colours, linewidth=5, alpha=0.35)
    thin = [each.seeds for each in found.values()]
    seen, left, right = _intervals(axis, places + OFFSET, thin, colours, linewidth=1.2)
    for ends, outside, arrow in ((left, left < low, "<"), (right, right > high, ">")):
        for mark, chosen in (("|", seen & ~outside), (arrow, seen & outside)):
            style: dict[str, Any] = {"s": 26, "c": colours[chosen], "linewidths": 1.2, "clip_on": False}
            axis.scatter(ends[chosen].clip(low, high), places[chosen] + OFFSET, marker=mark, **style)
    values = np.array([each.value for each in found.values()])
    inside = (low <= values) & (values <= high)
    axis.scatter(values[inside], places[inside] - OFFSET / 2, s=22, c=colours[inside], zorder=4)
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
    for value, place, colour in zip(values, places - OFFSET / 2, colours, strict=True):
        if value < low or value > high:  # written at the edge
            text, x, side = (f"{value:+.3f} →", high, "right") if value > high else (f"← {value:+.3f}", low, "left")
            axis.text(x, place, text, ha=side, va="center", fontsize=8, color=colour, bbox=box, zorder=5)


def _intervals(
    axis: Axes, places: Floats, intervals: Sequence[Interval], colours: NDArray[Any], **style: Any
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Draw intervals as far as they lie in the plot; return which can be seen, and the ends of all."""
    left, right = np.array([(each.low, each.high) for each in intervals]).reshape(-1, 2).T
    low, high = axis.get_xlim()
    seen = (right >= low) & (left <= high)  # never of NaN
    axis.hlines(places[seen], left[seen].clip(low), right[seen].clip(max=high), colors=colours[seen].tolist(), **style)
    return seen, left, right


def _limits(found: Sequence[Contrast]) -> tuple[float, float]:
    """Return the ends of the axis: values and scenes fit, unless far out; t intervals of two seeds often do not."""
    reach = [max(abs(each.value), abs(each.scenes.low), abs(each.scenes.high)) for each in found if each.scenes.known]
    largest = usual_range(reach or [abs(each.value) for each in found])[1]
    near = [each for each in found if abs(each.value) <= largest]
    ends = [0.0, *(end for each in near for end in (each.value, each.scenes.low, each.scenes.high))]
    thin = [end for each in near for end in (each.seeds.low, each.seeds.high) if abs(end) <= 2 * largest]
    known = [end for end in (*ends, *thin) if end == end]
    margin = 0.08 * (max(known) - min(known)) or 1e-3
    return min(known) - margin, max(known) + margin
