"""Differences from the reference, one line per row, with both intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from hudepth.metrics.catalogue import metric_info, metric_names
from hudepth.report.ablation.estimates import BETTER, NOT_SHOWN, WORSE, Contrast, Interval
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.rows import Row
from hudepth.viz.limits import usual_range
from hudepth.viz.style import BLUE, ORANGE, shorten, strip_frame

COLOURS = {BETTER: BLUE, WORSE: ORANGE, NOT_SHOWN: "0.45"}
OFFSET = 0.17
"""From the middle of a row to its two intervals."""


def draw_effects(report: Report) -> Figure:
    """Draw one panel per metric, in it one line per row: its difference from the reference and both intervals.

    Args:
        report: with at least one row that was paired with the reference.
    """
    rows = [row for row in report.rows if row.contrasts]
    names = [*metric_names("headline", among=report.metrics), *metric_names("edge", among=report.metrics)[:1]]
    height = 1.35 + len(rows) * max(0.2, min(0.36, 14 / len(rows)))
    figure = Figure(figsize=(2.4 + 2.5 * len(names), height), dpi=130, layout="constrained")
    figure.suptitle(f"difference from {shorten(report.reference.label)}", fontsize=11)
    axes = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    for name, axis in zip(names, axes, strict=True):
        _panel(axis, rows, name)
    axes[0].set_yticks(range(len(rows)), [shorten(row.label) for row in rows], fontsize=9)
    axes[0].set_ylim(len(rows) - 0.45, -0.55)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def _panel(axis: Axes, rows: Sequence[Row], name: str) -> None:
    found = [(place, row.contrasts[name]) for place, row in enumerate(rows) if name in row.contrasts]
    axis.axvline(0, color="0.3", linewidth=0.9)
    low, high = _limits([each for _, each in found])
    axis.set_xlim(low, high)
    _bars(axis, [(place - OFFSET / 2, each.scenes, COLOURS[each.verdict]) for place, each in found], thick=True)
    _bars(axis, [(place + OFFSET, each.seeds, COLOURS[each.verdict]) for place, each in found], thick=False)
    dots = [(each.value, place - OFFSET / 2, COLOURS[each.verdict]) for place, each in found]
    inside = [dot for dot in dots if low <= dot[0] <= high]
    axis.scatter([x for x, _, _ in inside], [y for _, y, _ in inside], s=22, c=[c for _, _, c in inside], zorder=4)
    for value, place, colour in dots:
        if value < low or value > high:
            _beyond(axis, value, place, colour)
    _finish(axis, name)


def _finish(axis: Axes, name: str) -> None:
    axis.set_title(metric_info(name).label, fontsize=10)
    axis.set_xlabel("better →" if metric_info(name).higher_is_better else "← better", fontsize=9)
    axis.tick_params(axis="x", labelsize=8)
    axis.locator_params(axis="x", nbins=5)
    axis.tick_params(axis="y", length=0)
    axis.grid(axis="x", alpha=0.25)
    axis.set_axisbelow(True)
    strip_frame(axis, "top", "right", "left")


def _bars(axis: Axes, bars: Sequence[tuple[float, Interval, str]], *, thick: bool) -> None:
    """Draw intervals, all at once; an arrow marks where a thin one leaves the plot."""
    left, right = axis.get_xlim()
    seen = [bar for bar in bars if bar[1].known and bar[1].high >= left and bar[1].low <= right]
    places, colours = [place for place, _, _ in seen], [colour for _, _, colour in seen]
    lows, highs = [max(each.low, left) for _, each, _ in seen], [min(each.high, right) for _, each, _ in seen]
    style: dict[str, Any] = {"linewidth": 5, "alpha": 0.35} if thick else {"linewidth": 1.2}
    axis.hlines(places, lows, highs, colors=colours, **style)
    if thick:
        return
    ends = [(x, y, "<" if each.low < left else "|", c) for x, (y, each, c) in zip(lows, seen, strict=True)]
    ends += [(x, y, ">" if each.high > right else "|", c) for x, (y, each, c) in zip(highs, seen, strict=True)]
    for mark in "|<>":
        points = [(x, y, colour) for x, y, kind, colour in ends if kind == mark]
        xs, ys, inks = ([point[i] for point in points] for i in range(3))
        axis.scatter(xs, ys, s=26, c=inks, marker=mark, linewidths=1.2, clip_on=False)


def _beyond(axis: Axes, value: float, place: float, colour: str) -> None:
    """Write a difference that lies outside the plot at its edge."""
    left, right = axis.get_xlim()
    text, x, side = (f"{value:+.3f} →", right, "right") if value > right else (f"← {value:+.3f}", left, "left")
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
    axis.text(x, place, text, ha=side, va="center", fontsize=8, color=colour, bbox=box, zorder=5)


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


def _legend() -> list[Line2D]:
    return [
        *(Line2D([], [], color=colour, marker="o", linewidth=0, label=word) for word, colour in COLOURS.items()),
        Line2D([], [], color="0.45", linewidth=5, alpha=0.45, label="95 % over scenes"),
        Line2D([], [], color="0.45", linewidth=1.2, marker="|", label="95 % over seeds"),
    ]
