"""What a training starts from: its configuration, its run directory, and its initial weights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from hudepth.base.console import log
from hudepth.base.errors import HudepthError
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.lineage import BEFORE, lineage, refuse_training_pairs
from hudepth.models.inference import inference_form
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
        return start_from(net, training, data) if training.options.init else []
    if epochs := sorted({look["epoch"] for look in run_dir.read_scored(training.path)}):
        log.warning(
            "this run was tested after epoch %s. If that is why it is resumed, its next test is too good; metrics.json "
            "will note it (scored_before)", ", ".join(map(str, epochs)),
        )  # fmt: skip
    parents: Parents = load_checkpoint(str(training.last)).data.get(BEFORE, [])
    return parents


class Rescaled(nn.Module):
    """A network whose unit depth is of another maximum depth: its output times ``factor``."""

    def __init__(self, net: nn.Module, factor: float) -> None:
        super().__init__()
        self.net, self.factor = net, factor

    def forward(self, image: Tensor) -> Tensor:
        """Return depth / max_depth_m of this training."""
        depth: Tensor = self.net(image)
        return depth * self.factor


def network_before(training: Training, *, size: tuple[int, int], max_depth_m: float) -> nn.Module | None:
    """Return the network that a training started from with ``init=``; None without, or if it is not there any more."""
    if not training.options.init or not training.options.baselines:
        return None
    try:
        checkpoint = load_checkpoint(str(training.config["init"]), runs=training.config["paths"]["runs"], key="init")
        net = checkpoint.build_net(trust=training.options.trust)
        before_m = float(checkpoint.config["data"]["max_depth_m"])
    except (HudepthError, KeyError, TypeError, ValueError) as error:
        log.warning("the network before training is not scored: %s", error)
        return None
    net = inference_form(net, size=size)
    return net if before_m == max_depth_m else Rescaled(net, before_m / max_depth_m)


def start_from(net: nn.Module, training: Training, datamodule: DepthDataModule) -> Parents:
    """Load the weights of ``init`` into a network; return what they were trained on.

    The parts in ``init_skip`` stay as they are. Raises CheckpointError if there is no such checkpoint or it
    belongs to another network, DataError if it was trained on pairs that this training validates or tests on.
    """
    checkpoint = load_checkpoint(str(training.options.init), runs=training.config["paths"]["runs"], key="init")
    refuse_training_pairs(checkpoint, datamodule, subsets=("val", "test"))
    skip = training.options.init_skip or ()
    checkpoint.fill(net, skip=skip)
    but = f", but {' and '.join(skip)}" if skip else ""
    log.info("init: weights of '%s', epoch %d%s", checkpoint.path, checkpoint.epoch, but)
    trained = checkpoint.config.get("data")
    before_m = trained.get("max_depth_m") if isinstance(trained, dict) else None
    if before_m != datamodule.max_depth_m:
        log.warning(
            "init: these weights predict depth / %s m, this training depth / %s m, so all depths are learned from "
            "scratch. Pass data.max_depth_m=%s to keep them.",
            before_m, datamodule.max_depth_m, before_m,
        )  # fmt: skip
    return lineage(checkpoint)
