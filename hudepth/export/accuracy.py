"""What int8 costs in accuracy: the checkpoint and its quantised form on the same test images, in one pass."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from lightning.pytorch.callbacks import RichProgressBar
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from hudepth.base.console import shows_progress
from hudepth.base.devices import build_trainer, without_known_warnings
from hudepth.base.normalise import denormalise_image
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.lineage import note_scored
from hudepth.evaluation.protocols import build_protocols
from hudepth.evaluation.routine import Evaluation
from hudepth.evaluation.scoring import image_table
from hudepth.inference.backends import Backend, TorchBackend
from hudepth.metrics.bootstrap import Difference, paired_differences
from hudepth.metrics.summary import summarise
from hudepth.runs.checkpoint import Checkpoint

SHOWN = ("abs_rel", "rmse", "delta1")
FLOAT, INT8 = "float32", "int8"


class _Quantised(nn.Module):
    """A backend where a network is expected: bytes again from the normalised image, unit depth again from metres."""

    def __init__(self, backend: Backend) -> None:
        super().__init__()
        self.backend = backend

    def forward(self, image: Tensor) -> Tensor:
        rgb = denormalise_image(image).mul(255).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)
        depth_m = self.backend(np.ascontiguousarray(rgb.cpu().numpy()))
        return torch.from_numpy(depth_m)[:, None] / self.backend.info.max_depth_m


def int8_accuracy(
    checkpoint: Checkpoint,
    reference: TorchBackend,
    quantised: Backend,
    datamodule: DepthDataModule,
    *,
    config: dict[str, Any],
) -> dict[str, Any]:
    """Test both under the configured protocol, print what changes, and return it; the checkpoint's run notes the test.

    Args:
        checkpoint: what was quantised.
        reference: its network as it was trained.
        quantised: its int8 form.
        datamodule: with the test subset.
        config: of hudepth-export.

    Returns:
        By metric: both values, their difference and its 95 % interval over scenes.

    Raises:
        HudepthError: with one line for the user.
    """
    protocols = build_protocols(config["protocol"], datamodule=datamodule, trust=config["trust"])
    predictors: dict[str, nn.Module] = {FLOAT: reference.pipeline.net, INT8: _Quantised(quantised)}
    evaluation = Evaluation(predictors, protocols, max_depth_m=datamodule.max_depth_m)
    with without_known_warnings():
        trainer = build_trainer(
            {"accelerator": "cpu", "devices": 1},
            logger=False, enable_checkpointing=False, enable_model_summary=False, inference_mode=True,
            enable_progress_bar=shows_progress(), callbacks=[RichProgressBar()] if shows_progress() else None,
        )  # fmt: skip
        trainer.test(evaluation, datamodule=datamodule, verbose=False)
    note_scored(checkpoint, datamodule, protocols)
    records = [datamodule.store.records[index] for index in evaluation.indices]
    changes: dict[str, Any] = {}
    for protocol in protocols:
        tables = {n: image_table(protocol, evaluation.sums[n, protocol.name], records) for n in (FLOAT, INT8)}
        options = protocol.summary_options
        means = {name: summarise(table, **options) for name, table in tables.items()}
        differences = paired_differences(tables[FLOAT], tables[INT8], **options)
        changes[protocol.name] = {
            key: {FLOAT: means[FLOAT][key], INT8: means[INT8][key], **_stated(differences[key])} for key in SHOWN
        }
        _print(protocol.name, len(records), changes[protocol.name], datamodule.source.name)
    return changes


def _stated(difference: Difference) -> dict[str, Any]:
    ends = (difference.low, difference.high)  # not finite where there are too few scenes
    return {"change": difference.value, "interval": [end if math.isfinite(end) else None for end in ends]}


def _print(protocol: str, images: int, rows: dict[str, Any], source: str) -> None:
    table = Table()
    for column in ("", FLOAT, INT8, "change"):
        table.add_column(column, justify="left" if not column else "right")
    for key, row in rows.items():
        low, high = row["interval"]
        between = "" if low is None or high is None else f" [{low:+.4f}, {high:+.4f}]"  # too few scenes for one
        table.add_row(key, f"{row[FLOAT]:.4f}", f"{row[INT8]:.4f}", f"{row['change']:+.4f}{between}")
    out = Console(width=None if Console().is_terminal else 130)
    out.print(
        f"int8: {protocol} protocol, {images} test images of {source}; change: int8 less float32, 95 % over scenes"
    )
    out.print(table)
