"""Measure what int8 costs in accuracy: test a checkpoint and its quantised form in one pass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hudepth.base.normalise import denormalise_image
from hudepth.base.tables import Table
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.lineage import note_scored
from hudepth.evaluation.protocols import build_protocols
from hudepth.evaluation.routine import Evaluation
from hudepth.evaluation.score import run_evaluation
from hudepth.evaluation.scoring import image_table
from hudepth.inference.backends import Backend, TorchBackend
from hudepth.metrics.bootstrap import paired_differences
from hudepth.metrics.catalogue import metric_info, metric_names
from hudepth.metrics.summary import summarise
from hudepth.runs.checkpoint import Checkpoint

FLOAT, INT8 = "float32", "int8"


class _BackendNet(nn.Module):
    """A backend as a network: restores bytes from the normalised image, and unit depth from metres."""

    def __init__(self, backend: Backend) -> None:
        super().__init__()
        self.backend = backend

    def forward(self, image: Tensor) -> Tensor:
        rgb = denormalise_image(image).mul(255).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)
        depth_m = self.backend(np.ascontiguousarray(rgb.cpu().numpy()))
        return torch.from_numpy(depth_m)[:, None] / self.backend.info.max_depth_m


def measure_int8(
    checkpoint: Checkpoint,
    reference: TorchBackend,
    quantised: Backend,
    datamodule: DepthDataModule,
    *,
    protocols: Mapping[str, Any],
    trust: list[str],
) -> dict[str, Any]:
    """Test a network and its int8 form on the test subset, print the change, and note the test in the run.

    Returns, by protocol and metric, both values, their difference and its 95 % interval over scenes. Raises
    HudepthError, also if a class in ``protocols`` is neither hudepth's nor under ``trust``.
    """
    built = build_protocols(protocols, datamodule=datamodule, trust=trust)
    plain = reference.pipeline.net if reference.info.calibration is None else _BackendNet(reference)
    predictors: dict[str, nn.Module] = {FLOAT: plain, INT8: _BackendNet(quantised)}
    evaluation = Evaluation(predictors, built, max_depth_m=datamodule.max_depth_m)
    run_evaluation(evaluation, datamodule, {"accelerator": "cpu"})
    note_scored(checkpoint, datamodule, built)
    records = [datamodule.store.records[index] for index in evaluation.indices]
    changes: dict[str, Any] = {}
    for protocol in built:
        tables = [image_table(protocol, evaluation.sums[name, protocol.name], records) for name in (FLOAT, INT8)]
        before, after = (summarise(table, **protocol.summary_options) for table in tables)
        differences = paired_differences(*tables, **protocol.summary_options)
        rows = changes[protocol.name] = {}
        for key in metric_names("headline"):
            change = differences[key]
            ends = [end if math.isfinite(end) else None for end in (change.low, change.high)]  # None: too few scenes
            rows[key] = {FLOAT: before[key], INT8: after[key], "change": change.value, "interval": ends}
        _print(protocol.name, rows, images=f"{len(records)} test images of {datamodule.source.name}")
    return changes


def _print(protocol: str, rows: Mapping[str, Any], *, images: str) -> None:
    caption = "change: int8 minus float32, with the 95 % interval over scenes"
    table = Table(["", FLOAT, INT8, "change"], title=f"int8: {protocol} protocol, {images}", caption=caption)
    for key, row in rows.items():
        info, (low, high) = metric_info(key), row["interval"]
        digits = info.decimals + 1  # changes are small
        unit = f" {info.unit}" if info.unit else ""
        interval = "" if low is None or high is None else f" ({low:+.{digits}f} to {high:+.{digits}f}{unit})"
        values = (f"{row[name]:.{digits}f}{unit}" for name in (FLOAT, INT8))
        table.add(info.name, *values, f"{row['change']:+.{digits}f}{unit}{interval}")
    table.show()
