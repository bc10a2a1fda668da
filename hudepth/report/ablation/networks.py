"""What a report of a sweep needs networks for: their predictions of some test images, and what they cost."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from hudepth.base.console import log
from hudepth.base.errors import HudepthError
from hudepth.base.instantiate import instantiate
from hudepth.evaluation.pictures import evenly_spaced, panels_beside
from hudepth.models.cost import counted_flops, parameters
from hudepth.report.ablation.factors import spelt
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.row import Row
from hudepth.report.ablation.tradeoff import Cost
from hudepth.viz.panels import Panel


def predictions(
    rows: Mapping[str, Path], images: Sequence[str], *, count: int, config: Mapping[str, Any]
) -> tuple[dict[str, list[Panel]], list[str]]:
    """Let several runs predict the same test images.

    A run whose checkpoint or data cannot be opened is left out, with a line in the log.

    Args:
        rows: run directories by the name to show.
        images: ids of the test images.
        count: how many of them, evenly spaced.
        config: as for :func:`hudepth.evaluation.pictures.run_panels`.

    Returns:
        Panels by name, and the ids that were chosen.
    """
    ids = sorted(images)
    chosen = [ids[place] for place in evenly_spaced(range(len(ids)), count)]
    found: dict[str, list[Panel]] = {}
    for name, run in rows.items():
        try:
            found[name] = panels_beside({name: run}, chosen, config=config)
        except HudepthError as error:
            log.warning("not in panels.png: '%s': %s", name, error)
    return found, chosen


def costs(report: Report, *, trust: Sequence[str] = ()) -> list[Cost]:
    """Return what the network of each row with a result costs; empty if it is the same for all.

    Networks are laid out without memory, so that none of their values is made or read.

    Args:
        report: of the sweep.
        trust: further modules whose classes a configuration may name.

    Raises:
        HudepthError: if a configuration cannot be built.
    """
    known: dict[str, tuple[int, int]] = {}
    found = []
    for row in report.rows:
        if row.runs:
            model, size = _network(row)
            key = f"{spelt(model)} {spelt(size)}"
            known[key] = known.get(key) or _count(model, size, trust)
            found.append(Cost(row.label, *known[key], row.estimates["abs_rel"]))
    return found if len(set(known.values())) > 1 else []


def _network(row: Row) -> tuple[dict[str, Any], list[int]]:
    config = next(iter(row.runs.values())).run.config
    model = copy.deepcopy(dict(config["model"]))
    if "weights" in model:
        model["weights"] = None  # what it starts from costs nothing
    return model, [int(side) for side in config["data"]["size"]]


def _count(model: Mapping[str, Any], size: Sequence[int], trust: Sequence[str]) -> tuple[int, int]:
    with torch.device("meta"):
        network = instantiate(model, trust=trust, only=object if trust else nn.Module)
    image = torch.empty(1, 3, *size, device="meta")
    return parameters(network), counted_flops(network, image) // 2
