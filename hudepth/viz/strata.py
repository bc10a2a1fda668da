"""Errors by depth, distance to an edge, region and category: one plot per group."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hudepth.metrics.strata import Stratum
from hudepth.viz.panels import save_figure

RARE = 0.01
"""A bin with a smaller share of its group's pixels is drawn pale and does not set the limits."""


def draw_strata(rows: Sequence[Stratum], *, title: str = "") -> Figure:
    """Draw abs_rel of each bin (at least one) as a bar, and the bin's share of the pixels next to its name."""
    groups = [[row for row in rows if row.group == group] for group in dict.fromkeys(row.group for row in rows)]
    lines = -(-len(groups) // 2)
    heights = [max(len(group) for group in groups[2 * i : 2 * i + 2]) + 2.5 for i in range(lines)]
    figure = Figure(figsize=(9.6, 0.27 * sum(heights) + 0.5), dpi=110, layout="constrained")
    figure.suptitle(title, fontsize=11)
    axes = figure.subplots(lines, 2, squeeze=False, sharex=True, gridspec_kw={"height_ratios": heights}).ravel()
    finite = [row for row in rows if math.isfinite(row.abs_rel)]
    common = [row.abs_rel for row in finite if row.share >= RARE] or [row.abs_rel for row in finite]
    for axis, group in zip(axes, groups, strict=False):
        _draw_group(axis, group, right=1.18 * max(common, default=0) or 1.0)
    for axis in axes[len(groups) :]:
        axis.set_axis_off()
    return figure


def _draw_group(axis: Axes, rows: Sequence[Stratum], *, right: float) -> None:
    for place, row in enumerate(rows):
        # no bar for NaN or infinity, only the number
        length = row.abs_rel if math.isfinite(row.abs_rel) else 0.0
        axis.barh(place, length, height=0.72, color="tab:blue", alpha=1 if row.share >= RARE else 0.35)
        # a bar longer than the axis has its number inside
        end, side = (length, "left") if length < 0.9 * right else (right, "right")
        axis.annotate(f" {row.abs_rel:.3f} ", (end, place), ha=side, va="center", fontsize=8)
    shares = [f"{100 * row.share:.0f} %" if row.share >= RARE else "< 1 %" for row in rows]
    labels = [f"{row.label.replace('_', ' ')}   {share}" for row, share in zip(rows, shares, strict=True)]
    axis.set_yticks(range(len(rows)), labels, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlim(0, right)
    axis.set_title(f"by {rows[0].group}: abs_rel, and share of the pixels", fontsize=9, loc="left")
    axis.tick_params(labelbottom=True, axis="x", labelsize=8)
    axis.grid(axis="x", alpha=0.3)
    axis.set_axisbelow(True)


def save_strata(path: Path, rows: Sequence[Stratum], *, title: str = "") -> None:
    """Write :func:`draw_strata` as a PNG file."""
    save_figure(path, draw_strata(rows, title=title))
