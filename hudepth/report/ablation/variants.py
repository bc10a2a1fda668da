"""Validation curves of each row of a sweep: mean over seeds, with their range as a band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hudepth.metrics.catalogue import metric_info, metric_names
from hudepth.metrics.summary import Floats
from hudepth.viz.limits import usual_range
from hudepth.viz.style import COLOURS, shorten, strip_frame

STYLES = ("-", "--")
OTHER = "0.8"
History = Sequence[Mapping[str, float]]
Band = tuple[Floats, Floats, Floats, Floats]  # epochs, mean over the seeds, lowest, highest


def draw_variants(histories: Mapping[str, Sequence[History]], *, shown: Sequence[str], monitor: str = "") -> Figure:
    """Draw a plot per headline metric, or of ``monitor``; in it a line per row, from its metrics.csv of each seed.

    Rows in ``shown`` get a colour and a name, the most important first; the others are grey.
    """
    known = {key for runs in histories.values() for run in runs for row in run for key in row}
    keys = [f"val/{name}" for name in metric_names("headline") if f"val/{name}" in known]
    keys = keys or [key for key in (monitor,) if key in known]
    figure = Figure(figsize=(1.8 + 3.6 * max(1, len(keys)), 3.9), dpi=130, layout="constrained")
    axes = figure.subplots(1, max(1, len(keys)), squeeze=False)[0]
    shown = [label for label in shown if label in histories][: len(COLOURS) * len(STYLES)]
    for axis, key in zip(axes, keys, strict=False):
        _plot(axis, {label: band(runs, key) for label, runs in histories.items()}, key, shown)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8, frameon=False)
    return figure


def band(runs: Sequence[History], key: str) -> Band:
    """Return mean, lowest and highest of at least one seed at the epochs that all of them have."""
    columns = [{row["epoch"]: row[key] for row in run if key in row} for run in runs]
    epochs = sorted(set.intersection(*(set(column) for column in columns)))
    table = [[column[epoch] for epoch in epochs] for column in columns]
    values = np.array(table, dtype=np.float64).reshape(len(columns), len(epochs))
    return np.array(epochs, dtype=np.float64), values.mean(axis=0), values.min(axis=0), values.max(axis=0)


def _plot(axis: Axes, bands: Mapping[str, Band], key: str, shown: Sequence[str]) -> None:
    others = [label for label in bands if label not in shown]
    for number, label in enumerate(others):
        epochs, mean, _, _ = bands[label]
        named: dict[str, Any] = {} if number else {"label": f"{len(others)} others"}
        axis.plot(epochs, mean, color=OTHER, linewidth=0.8, zorder=1, **named)
    bottom, top = _limits(list(bands.values()))
    for number, label in enumerate(shown):
        epochs, mean, low, high = bands[label]
        word = shorten(label) if len(mean) and bottom <= mean[-1] <= top else f"{shorten(label)} (outside)"
        colour = COLOURS[number % len(COLOURS)]
        style: dict[str, Any] = {"linestyle": STYLES[number // len(COLOURS)], "linewidth": 2.0 if not number else 1.4}
        marker = "." if len(epochs) < 40 else ""
        axis.plot(epochs, mean, color=colour, marker=marker, label=word, zorder=4 - number / 100, **style)
        axis.fill_between(epochs, low, high, color=colour, alpha=0.15, linewidth=0, zorder=2)
    axis.set_ylim(bottom, top)
    way = "higher" if metric_info(key).higher_is_better else "lower"
    axis.set_title(f"{key.removeprefix('val/')} in validation ({way} is better)", fontsize=9)
    axis.set_xlabel("epoch", fontsize=9)
    axis.tick_params(labelsize=8)
    axis.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=1))
    axis.grid(alpha=0.25)
    strip_frame(axis)


def _limits(bands: Sequence[Band]) -> tuple[float, float]:
    """Return limits that hold every line whose last value is not far out."""
    ends = [mean[-1] for _, mean, _, _ in bands if len(mean)]
    low, high = usual_range(ends)
    kept = [each for each in bands if len(each[1]) and low <= each[1][-1] <= high]
    bottom = min((float(np.nanmin(each[2])) for each in kept), default=0.0)
    top = max((float(np.nanmax(each[3])) for each in kept), default=1.0)
    margin = 0.05 * (top - bottom) or 0.01
    return bottom - margin, top + margin
