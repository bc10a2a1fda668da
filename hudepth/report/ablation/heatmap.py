"""A metric over the weights of the loss's terms, where a sweep forms a grid of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hudepth.metrics.catalogue import metric_info
from hudepth.report.ablation.factors import format_value
from hudepth.report.ablation.rows import Row
from hudepth.runs.identity import canonical
from hudepth.viz.colour import SCORE_COLOURS, colour_map
from hudepth.viz.limits import usual_range
from hudepth.viz.style import ORANGE, strip_frame

WEIGHTS = ("loss.boundary", "loss.smoothness", "loss.scaling")
EMPTY = "0.9"


@dataclass(frozen=True)
class Grid:
    """Rows that differ in nothing but the weights: names, and formatted values from the lowest up."""

    y: str
    x: str
    panel: str  # empty if the third weight does not vary
    ys: list[str]
    xs: list[str]
    panels: list[str]
    cells: dict[tuple[str, str, str], Row]  # by value of panel, y and x


def find_grid(rows: Sequence[Row]) -> Grid | None:
    """Return the largest grid of rows that differ in weights alone; None if no two weights have two values each."""
    groups: dict[tuple[tuple[str, str], ...], list[Row]] = {}
    for row in rows:
        if row.runs and all(key in row.config for key in WEIGHTS):
            rest = tuple((key, canonical(value)) for key, value in sorted(row.config.items()) if key not in WEIGHTS)
            groups.setdefault(rest, []).append(row)
    group = max(groups.values(), key=len, default=[])
    values = {key: _sort_values([row.config[key] for row in group]) for key in WEIGHTS}
    varied = [key for key in WEIGHTS if len(values[key]) > 1]
    if len(varied) < 2:
        return None
    y, x, panel = (*varied, "")[:3]
    cells = {}
    for row in group:
        where, down, across = (format_value(row.config[key]) if key else "" for key in (panel, y, x))
        cells[where, down, across] = row
    down, across, where = (key.rpartition(".")[2] for key in (y, x, panel))
    return Grid(down, across, where, values[y], values[x], values.get(panel, [""]), cells)


def _sort_values(found: Sequence[Any]) -> list[str]:
    def order(value: Any) -> tuple[bool, float, str]:
        return (False, value, str(value)) if isinstance(value, int | float) else (True, 0, str(value))

    distinct = {canonical(value): value for value in found}
    return list(dict.fromkeys(format_value(value) for value in sorted(distinct.values(), key=order)))


def draw_heatmap(grid: Grid, *, metric: str = "abs_rel") -> Figure:
    """Draw one panel per value of the third weight: the metric's mean over seeds in each cell, the best ringed."""
    tall, wide, count, info = len(grid.ys), len(grid.xs), len(grid.panels), metric_info(metric)
    figure = Figure(figsize=(1.9 + count * (0.6 + 0.95 * wide), 1.5 + 0.75 * tall), dpi=130, layout="constrained")
    axes = figure.subplots(1, count, squeeze=False, sharey=True)[0]
    means = {where: row.estimates[metric].mean for where, row in grid.cells.items()}
    known = [mean for mean in means.values() if math.isfinite(mean)]
    low, high = usual_range(known)
    best = (max if info.higher_is_better else min)(known, default=math.nan)
    scale: dict[str, Any] = {"vmin": low, "vmax": high if high > low else low + 1e-3}
    colours = colour_map(SCORE_COLOURS if info.higher_is_better else f"{SCORE_COLOURS}_r")
    scale["cmap"] = colours.with_extremes(bad=EMPTY)
    for axis, panel in zip(axes, grid.panels, strict=True):
        values = np.array([[means.get((panel, y, x), math.nan) for x in grid.xs] for y in grid.ys])
        drawn = axis.imshow(values, aspect="auto", **scale)
        for y, x in np.ndindex(*values.shape):
            value = float(values[y, x])
            is_light = (value > (scale["vmin"] + scale["vmax"]) / 2) == info.higher_is_better
            # a cell without a run has a dash
            text, colour = (f"{value:.4f}", "black" if is_light else "white") if math.isfinite(value) else ("–", "0.5")
            weight = "bold" if value == best else "normal"
            axis.text(x, y, text, ha="center", va="center", fontsize=9, color=colour, fontweight=weight)
            if value == best:
                ring = Rectangle((x - 0.47, y - 0.46), 0.94, 0.92, fill=False, edgecolor=ORANGE, linewidth=2.2)
                axis.add_patch(ring)
        axis.set_xticks(range(wide), grid.xs, fontsize=9)
        axis.set_yticks(range(tall), grid.ys, fontsize=9)
        axis.tick_params(length=0)
        axis.set_xlabel(grid.x, fontsize=10)
        if grid.panel:
            axis.set_title(f"{grid.panel} = {panel}", fontsize=10)
        strip_frame(axis, "top", "right", "bottom", "left")
    axes[0].set_ylabel(grid.y, fontsize=10)
    bar = figure.colorbar(drawn, ax=list(axes), extend="max" if max(known, default=0) > high else "neither")
    bar.set_label(f"{info.label}, {'higher' if info.higher_is_better else 'lower'} is better", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure
