"""Differences from the reference, a line each: which rows are better, by how much, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from hudepth.lab.estimates import BETTER, NOT_SHOWN, WORSE, Contrast, Interval
from hudepth.lab.report import UNITS, Report
from hudepth.lab.row import Row
from hudepth.metrics.summary import higher_is_better
from hudepth.viz.limits import usual_range
from hudepth.viz.panels import save_figure

COLOURS = {BETTER: "#0072b2", WORSE: "#d55e00", NOT_SHOWN: "0.45"}
"""Told apart by everyone (Okabe and Ito 2008)."""
METRICS = ("abs_rel", "rmse", "delta1")
LONGEST = 34
"""Letters of a row's label."""
OFFSET = 0.17
"""Of the two intervals from the middle of their row."""


def draw_effects(report: Report) -> Figure:
    """Draw a panel a metric and in it a line a row: its difference from the reference and both intervals.

    Args:
        report: with at least one row that was paired with the reference.
    """
    rows = [row for row in report.rows if row.contrasts]
    names = [name for name in METRICS if name in report.metrics]
    names += [name for name in report.metrics if name.startswith(("edge", "si_"))][:1]
    height = 1.35 + len(rows) * max(0.2, min(0.36, 14 / len(rows)))
    figure = Figure(figsize=(2.4 + 2.5 * len(names), height), dpi=130, layout="constrained")
    figure.suptitle(f"difference from {_short(report.reference.label)}", fontsize=11)
    axes = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    for name, axis in zip(names, axes, strict=True):
        _panel(axis, rows, name)
    axes[0].set_yticks(range(len(rows)), [_short(row.label) for row in rows], fontsize=9)
    axes[0].set_ylim(len(rows) - 0.45, -0.55)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def save_effects(path: Path, report: Report) -> None:
    """Write :func:`draw_effects` as a PNG file, whole or not at all."""
    save_figure(path, draw_effects(report))


def _panel(axis: Axes, rows: Sequence[Row], name: str) -> None:
    found = [(place, row.contrasts[name]) for place, row in enumerate(rows) if name in row.contrasts]
    axis.axvline(0, color="0.3", linewidth=0.9)
    low, high = _limits([each for _, each in found])
    axis.set_xlim(low, high)
    for place, each in found:
        colour = COLOURS[each.verdict]
        _bar(axis, each.scenes, place - OFFSET / 2, colour, linewidth=5, alpha=0.35, solid_capstyle="butt")
        _bar(axis, each.seeds, place + OFFSET, colour, linewidth=1.2)
        if low <= each.value <= high:
            axis.plot(each.value, place - OFFSET / 2, "o", color=colour, markersize=4.5, zorder=4)
        else:
            _beyond(axis, each.value, place, colour)
    unit = f" [{UNITS[name]}]" if name in UNITS else ""
    axis.set_title(name + unit, fontsize=10)
    axis.set_xlabel("better →" if higher_is_better(name) else "← better", fontsize=9)
    axis.tick_params(axis="x", labelsize=8)
    axis.locator_params(axis="x", nbins=5)
    axis.tick_params(axis="y", length=0)
    axis.grid(axis="x", alpha=0.25)
    axis.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axis.spines[side].set_visible(False)


def _bar(axis: Axes, interval: Interval, place: float, colour: str, **style: Any) -> None:
    """Draw an interval; where it leaves the plot, an arrow says so."""
    if not interval.known:
        return
    left, right = axis.get_xlim()
    if interval.high < left or interval.low > right:
        return
    ends = [min(max(end, left), right) for end in (interval.low, interval.high)]
    axis.plot(ends, [place, place], color=colour, **style)
    if style["linewidth"] < 2:  # the thin one: caps, or arrows
        marks = ("<" if interval.low < left else "|", ">" if interval.high > right else "|")
        for end, mark in zip(ends, marks, strict=True):
            axis.plot(end, place, mark, color=colour, markersize=5, clip_on=False)


def _beyond(axis: Axes, value: float, place: float, colour: str) -> None:
    """Write down a difference that lies outside the plot."""
    left, right = axis.get_xlim()
    on_right = value > right
    text = f"{value:+.3f} →" if on_right else f"← {value:+.3f}"
    axis.text(
        right if on_right else left, place - OFFSET / 2, text, ha="right" if on_right else "left", va="center",
        fontsize=8, color=colour, bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8}, zorder=5,
    )  # fmt: skip


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
    words = [Line2D([], [], color=colour, marker="o", linewidth=0, label=word) for word, colour in COLOURS.items()]
    return [
        *words,
        Line2D([], [], color="0.45", linewidth=5, alpha=0.45, label="95 % over scenes"),
        Line2D([], [], color="0.45", linewidth=1.2, marker="|", label="95 % over seeds"),
    ]


def _short(label: str) -> str:
    return label if len(label) <= LONGEST else f"{label[: LONGEST - 1]}…"
