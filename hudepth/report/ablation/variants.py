"""How validation went in each row of a sweep: mean over the seeds, and their range as a band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hudepth.metrics.summary import higher_is_better
from hudepth.viz.limits import usual_range
from hudepth.viz.panels import save_figure

COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#8c6d31")
"""Told apart by everyone (Okabe and Ito 2008), but for the last, a yellow that is too light for a line."""
STYLES = ("-", "--")
PREFERRED = ("val/abs_rel", "val/rmse", "val/delta1")
OTHER = "0.8"

History = Sequence[Mapping[str, float]]
Band = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""Epochs, mean over the seeds, lowest, highest."""


def draw_variants(histories: Mapping[str, Sequence[History]], *, shown: Sequence[str], monitor: str = "") -> Figure:
    """Draw a plot a validation metric, and in it a line a row.

    Args:
        histories: by row, for each seed the rows of its metrics.csv.
        shown: rows that get a colour and a name, the most important first; the others are grey.
        monitor: the metric to draw if there is none of :data:`PREFERRED`.
    """
    known = {key for runs in histories.values() for run in runs for row in run for key in row}
    keys = [key for key in PREFERRED if key in known] or [key for key in (monitor,) if key in known]
    figure = Figure(figsize=(1.8 + 3.6 * max(1, len(keys)), 3.9), dpi=130, layout="constrained")
    axes = figure.subplots(1, max(1, len(keys)), squeeze=False)[0]
    shown = [label for label in shown if label in histories][: len(COLOURS) * len(STYLES)]
    for axis, key in zip(axes, keys, strict=False):
        _plot(axis, {label: band(runs, key) for label, runs in histories.items()}, key, shown)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8, frameon=False)
    return figure


def save_variants(
    path: Path, histories: Mapping[str, Sequence[History]], *, shown: Sequence[str], monitor: str = ""
) -> None:
    """Write :func:`draw_variants` as a PNG file, whole or not at all."""
    save_figure(path, draw_variants(histories, shown=shown, monitor=monitor))


def band(runs: Sequence[History], key: str) -> Band:
    """Return mean, lowest and highest of several seeds at the epochs that all of them have."""
    columns = [{row["epoch"]: row[key] for row in run if key in row} for run in runs]
    epochs = sorted(set.intersection(*(set(column) for column in columns))) if columns else []
    table = [[column[epoch] for epoch in epochs] for column in columns]
    values = np.array(table, dtype=np.float64).reshape(len(columns), len(epochs))
    x = np.array(epochs, dtype=np.float64)
    return (x, values.mean(axis=0), values.min(axis=0), values.max(axis=0)) if len(columns) else (x, x, x, x)


def _plot(axis: Axes, bands: Mapping[str, Band], key: str, shown: Sequence[str]) -> None:
    others = [label for label in bands if label not in shown]
    for number, label in enumerate(others):
        epochs, mean, _, _ = bands[label]
        named: dict[str, Any] = {} if number else {"label": f"{len(others)} others"}
        axis.plot(epochs, mean, color=OTHER, linewidth=0.8, zorder=1, **named)
    bottom, top = _limits(list(bands.values()))
    for number, label in enumerate(shown):
        epochs, mean, low, high = bands[label]
        word = _short(label) if len(mean) and bottom <= mean[-1] <= top else f"{_short(label)} (outside)"
        colour = COLOURS[number % len(COLOURS)]
        style: dict[str, Any] = {"linestyle": STYLES[number // len(COLOURS)], "linewidth": 2.0 if not number else 1.4}
        marker = "." if len(epochs) < 40 else ""
        axis.plot(epochs, mean, color=colour, marker=marker, label=word, zorder=4 - number / 100, **style)
        axis.fill_between(epochs, low, high, color=colour, alpha=0.15, linewidth=0, zorder=2)
    axis.set_ylim(bottom, top)
    name = key.removeprefix("val/")
    axis.set_title(f"{name} in validation ({'higher' if higher_is_better(name) else 'lower'} is better)", fontsize=9)
    axis.set_xlabel("epoch", fontsize=9)
    axis.tick_params(labelsize=8)
    axis.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=1))
    axis.grid(alpha=0.25)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def _limits(bands: Sequence[Band]) -> tuple[float, float]:
    """Return ends that hold every line whose last value is not far out."""
    ends = [mean[-1] for _, mean, _, _ in bands if len(mean)]
    low, high = usual_range(ends)
    kept = [each for each in bands if len(each[1]) and low <= each[1][-1] <= high]
    bottom = min((float(np.nanmin(each[2])) for each in kept), default=0.0)
    top = max((float(np.nanmax(each[3])) for each in kept), default=1.0)
    margin = 0.05 * (top - bottom) or 0.01
    return bottom - margin, top + margin


def _short(label: str) -> str:
    return label if len(label) <= 34 else f"{label[:33]}…"
