"""What a training starts from: its configuration, its run directory, and its initial weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from hudepth.base.console import log
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.lineage import BEFORE, lineage, refuse_training_pairs
from hudepth.runs import run_dir
from hudepth.runs.checkpoint import load_checkpoint
from hudepth.runs.run import CHECKPOINTS, LAST
from hudepth.training.options import TrainOptions

Parents = list[dict[str, Any]]
"""What the initial weights were trained on; see :mod:`hudepth.evaluation.lineage`."""


@dataclass(frozen=True)
class Training:
    """A configuration, the options parsed from it, and the run directory.

    ``overrides`` are those of a run that is resumed, None for a new run; ``alone`` means one process, whatever the
    cluster.
    """

    config: dict[str, Any]
    options: TrainOptions
    path: Path
    overrides: list[str] | None = None
    alone: bool = False

    @property
    def last(self) -> Path:
        """The checkpoint to resume from."""
        return self.path / CHECKPOINTS / LAST


def restore_parents(training: Training, net: nn.Module, data: DepthDataModule) -> Parents:
    """Return what the initial weights were trained on; load these weights if the run is new."""
    if training.overrides is None:
        return start_from(net, training.config, data) if training.options.init else []
    if epochs := sorted({look["epoch"] for look in run_dir.read_scored(training.path)}):
        log.warning(
            "this run was tested after epoch %s. If that is why it is resumed, its next test is too good; metrics.json "
            "will note it (scored_before)", ", ".join(map(str, epochs)),
        )  # fmt: skip
    parents: Parents = load_checkpoint(str(training.last)).data.get(BEFORE, [])
    return parents


def start_from(net: nn.Module, config: Mapping[str, Any], datamodule: DepthDataModule) -> Parents:
    """Load the weights of ``config["init"]`` into a network; return what they were trained on.

    Raises CheckpointError if there is no such checkpoint or it belongs to another network, DataError if it was trained
    on pairs that this training validates or tests on.
    """
    checkpoint = load_checkpoint(str(config["init"]), runs=config["paths"]["runs"])
    refuse_training_pairs(checkpoint, datamodule, subsets=("val", "test"))
    checkpoint.fill(net)
    log.info("init: weights of '%s', epoch %d", checkpoint.path, checkpoint.epoch)
    trained = checkpoint.config.get("data")
    before_m = trained.get("max_depth_m") if isinstance(trained, dict) else None
    if before_m != datamodule.max_depth_m:
        log.warning(
            "init: these weights predict depth / %s m, this training depth / %s m, so all depths are learned from "
            "scratch. Pass data.max_depth_m=%s to keep them.",
            before_m, datamodule.max_depth_m, before_m,
        )  # fmt: skip
    return lineage(checkpoint)
