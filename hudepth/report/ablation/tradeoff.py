"""Accuracy against what a network costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hudepth.report.ablation.estimates import Estimate
from hudepth.report.ablation.variants import COLOURS
from hudepth.viz.limits import usual_range
from hudepth.viz.panels import save_figure


@dataclass(frozen=True)
class Cost:
    """What the network of a row costs."""

    label: str
    parameters: int
    mult_adds: int
    """Of one image at the run's size."""
    estimate: Estimate


def draw_tradeoff(costs: Sequence[Cost], *, metric: str = "abs_rel") -> Figure:
    """Draw the metric of each row against parameters and against multiply-adds; bars are intervals over seeds."""
    figure = Figure(figsize=(9.6, 3.9), dpi=130, layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    low, high = usual_range(each.estimate.mean for each in costs)
    margin = 0.3 * (high - low) or 0.01
    axes[0].set_ylim(low - margin, high + margin)
    _points(axes[0], costs, [each.parameters / 1e6 for each in costs], "parameters [millions]")
    _points(axes[1], costs, [each.mult_adds / 1e9 for each in costs], "multiply-adds of an image [billions]")
    axes[0].set_ylabel(f"{metric}, mean over seeds", fontsize=9)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8, frameon=False)
    return figure


def save_tradeoff(path: Path, costs: Sequence[Cost], *, metric: str = "abs_rel") -> None:
    """Write :func:`draw_tradeoff` as a PNG file, whole or not at all."""
    save_figure(path, draw_tradeoff(costs, metric=metric))


def _points(axis: Axes, costs: Sequence[Cost], places: Sequence[float], title: str) -> None:
    for number, (each, place) in enumerate(zip(costs, places, strict=True)):
        colour = COLOURS[number % len(COLOURS)]
        marker = "os^Dv"[number // len(COLOURS) % 5]
        if each.estimate.seeds.known:
            ends = (each.estimate.seeds.low, each.estimate.seeds.high)
            axis.plot([place, place], ends, color=colour, linewidth=1, alpha=0.7)
        label = each.label if len(each.label) <= 34 else f"{each.label[:33]}…"
        value, (bottom, top) = each.estimate.mean, axis.get_ylim()
        if not bottom <= value <= top:  # far from all others
            axis.annotate(
                f"{value:.3f}", (place, top if value > top else bottom), fontsize=8, color=colour, ha="center"
            )
        shown = min(max(value, bottom), top)
        axis.plot(place, shown, marker, color=colour, markersize=7, label=label, clip_on=False)
    axis.set_xlabel(title, fontsize=9)
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.25)
    axis.margins(x=0.12)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
