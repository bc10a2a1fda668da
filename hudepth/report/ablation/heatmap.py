"""A metric over the weights of the loss's terms."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hudepth.metrics.summary import higher_is_better
from hudepth.report.ablation.grid import Grid
from hudepth.report.ablation.report import UNITS
from hudepth.viz.limits import usual_range
from hudepth.viz.panels import save_figure

EMPTY = "0.9"


def draw_heatmap(grid: Grid, *, metric: str = "abs_rel") -> Figure:
    """Draw a panel for each value of the third weight: the metric's mean over seeds in each cell, the best ringed.

    Args:
        grid: of at least two weights.
        metric: its name.
    """
    tall, wide, count = len(grid.ys), len(grid.xs), len(grid.panels)
    figure = Figure(figsize=(1.9 + count * (0.6 + 0.95 * wide), 1.5 + 0.75 * tall), dpi=130, layout="constrained")
    axes = figure.subplots(1, count, squeeze=False, sharey=True)[0]
    means = {where: row.estimates[metric].mean for where, row in grid.cells.items()}
    known = [mean for mean in means.values() if math.isfinite(mean)]
    low, high = usual_range(known)
    best = (max if higher_is_better(metric) else min)(known, default=math.nan)
    scale: dict[str, Any] = {"vmin": low, "vmax": high if high > low else low + 1e-3}
    scale["cmap"] = colormaps["viridis" if higher_is_better(metric) else "viridis_r"].with_extremes(bad=EMPTY)
    middle = (scale["vmin"] + scale["vmax"]) / 2
    for axis, panel in zip(axes, grid.panels, strict=True):
        values = np.array([[means.get((panel, y, x), math.nan) for x in grid.xs] for y in grid.ys])
        drawn = axis.imshow(values, aspect="auto", **scale)
        _write(axis, values, best=best, is_light=lambda value: (value > middle) == higher_is_better(metric))
        _label(axis, grid, panel)
    axes[0].set_ylabel(grid.y, fontsize=10)
    extend = "max" if max(known, default=0) > high else "neither"
    unit = f" [{UNITS[metric]}]" if metric in UNITS else ""
    word = "higher" if higher_is_better(metric) else "lower"
    bar = figure.colorbar(drawn, ax=list(axes), extend=extend)
    bar.set_label(f"{metric}{unit}, {word} is better", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure


def save_heatmap(path: Path, grid: Grid, *, metric: str = "abs_rel") -> None:
    """Write :func:`draw_heatmap` as a PNG file, whole or not at all."""
    save_figure(path, draw_heatmap(grid, metric=metric))


def _label(axis: Axes, grid: Grid, panel: str) -> None:
    axis.set_xticks(range(len(grid.xs)), grid.xs, fontsize=9)
    axis.set_yticks(range(len(grid.ys)), grid.ys, fontsize=9)
    axis.tick_params(length=0)
    axis.set_xlabel(grid.x, fontsize=10)
    if grid.panel:
        axis.set_title(f"{grid.panel} = {panel}", fontsize=10)
    for side in axis.spines.values():
        side.set_visible(False)


def _write(axis: Axes, values: Any, *, best: float, is_light: Callable[[float], bool]) -> None:
    """Write each cell's number on it; a cell without a run stays empty."""
    for y, x in np.ndindex(*values.shape):
        value = values[y, x]
        if not math.isfinite(value):
            axis.text(x, y, "–", ha="center", va="center", fontsize=9, color="0.5")
            continue
        colour = "black" if is_light(float(value)) else "white"
        weight = "bold" if value == best else "normal"
        axis.text(x, y, f"{value:.4f}", ha="center", va="center", fontsize=9, color=colour, fontweight=weight)
        if value == best:
            axis.add_patch(Rectangle((x - 0.47, y - 0.46), 0.94, 0.92, fill=False, edgecolor="#d55e00", linewidth=2.2))
