"""Accuracy against what a network costs."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hudepth.models.build import build_network
from hudepth.models.cost import counted_flops, parameters
from hudepth.report.ablation.estimates import Estimate
from hudepth.report.ablation.report import Report
from hudepth.runs.identity import canonical
from hudepth.viz.limits import usual_range
from hudepth.viz.style import COLOURS, shorten, strip_frame


@dataclass(frozen=True)
class Cost:
    """What the network of a row costs."""

    label: str
    parameters: int
    mult_adds: int  # for one image at the run's size
    estimate: Estimate


def find_costs(report: Report, *, metric: str, trust: Sequence[str] = ()) -> list[Cost]:
    """Return what the network of each row with a result costs, with its estimate of a metric; empty if all are equal.

    Networks are built on the meta device: no weight is allocated or read. Raises HudepthError if one cannot be built,
    as of a class from a module that ``trust`` does not list.
    """
    known: dict[str, tuple[int, int]] = {}
    found = []
    for row in report.rows:
        if row.runs:
            config = next(iter(row.runs.values())).run.config
            key = canonical([config["model"], config["data"]["size"]])
            known[key] = known.get(key) or _count(config, trust)
            found.append(Cost(row.label, *known[key], row.estimates[metric]))
    return found if len(set(known.values())) > 1 else []


def _count(config: Mapping[str, Any], trust: Sequence[str]) -> tuple[int, int]:
    model = copy.deepcopy(dict(config["model"]))
    if "weights" in model:
        model["weights"] = None  # pretrained weights do not change the cost
    with torch.device("meta"):
        network = build_network(model, trust=trust)
    image = torch.empty(1, 3, *(int(side) for side in config["data"]["size"]), device="meta")
    return parameters(network), counted_flops(network, image) // 2


def draw_cost(costs: Sequence[Cost], *, metric: str = "abs_rel") -> Figure:
    """Draw the metric of each row against parameters and against multiply-adds; bars are intervals over seeds."""
    figure = Figure(figsize=(9.6, 3.9), dpi=130, layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    axes[0].set_ylabel(f"{metric}, mean over seeds", fontsize=9)
    low, high = usual_range(each.estimate.mean for each in costs)
    margin = 0.3 * (high - low) or 0.01
    axes[0].set_ylim(low - margin, high + margin)
    _points(axes[0], costs, [each.parameters / 1e6 for each in costs], "parameters [millions]")
    _points(axes[1], costs, [each.mult_adds / 1e9 for each in costs], "multiply-adds per image [billions]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8, frameon=False)
    return figure


def _points(axis: Axes, costs: Sequence[Cost], places: Sequence[float], title: str) -> None:
    for number, (each, place) in enumerate(zip(costs, places, strict=True)):
        colour = COLOURS[number % len(COLOURS)]
        marker = "os^Dv"[number // len(COLOURS) % 5]
        if each.estimate.seeds.known:
            ends = (each.estimate.seeds.low, each.estimate.seeds.high)
            axis.plot([place, place], ends, color=colour, linewidth=1, alpha=0.7)
        value, (bottom, top) = each.estimate.mean, axis.get_ylim()
        shown = min(max(value, bottom), top)
        if shown != value:  # far from all others
            axis.annotate(f"{value:.3f}", (place, shown), fontsize=8, color=colour, ha="center")
        axis.plot(place, shown, marker, color=colour, markersize=7, label=shorten(each.label), clip_on=False)
    axis.set_xlabel(title, fontsize=9)
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.25)
    axis.margins(x=0.12)
    strip_frame(axis)
