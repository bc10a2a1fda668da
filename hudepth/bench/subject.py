"""The network that hudepth-bench measures: that of a checkpoint, or a model with random weights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from hudepth.base.errors import ConfigError
from hudepth.bench.plan import Plan
from hudepth.models.build import build_network
from hudepth.models.cost import image_flops, parameters
from hudepth.models.inference import inference_form

USUAL_SIZE, USUAL_MAX_DEPTH_M = (224, 224), 10.0
"""Of a model without a checkpoint."""


@dataclass(frozen=True)
class Subject:
    """The network that is measured: its class, configuration, and the file ``state`` of its tensors."""

    name: str
    model: dict[str, Any]
    trust: list[str]
    state: Path
    size: tuple[int, int]
    max_depth_m: float
    """Maximum depth [m]; the network predicts depth / max_depth_m."""
    parameters: int
    flops: int
    """Per image, of the network as trained."""
    merged_flops: int
    """Per image, of the form that hudepth-predict and hudepth-test run."""


def make_subject(plan: Plan, folder: Path, *, runs: str) -> Subject:
    """Build the network and write its tensors to ``folder``; ``checkpoint=last`` searches the folder ``runs``.

    Raises HudepthError if there is no such checkpoint, or the network cannot be built or does not accept the size.
    """
    trust = plan.trust or []
    if plan.checkpoint is not None:
        net, model, size, max_depth_m = _load(plan.checkpoint, runs, trust=trust, size=plan.size)
    else:
        assert plan.model is not None
        torch.manual_seed(0)
        model, size, max_depth_m = _without_weights(plan.model), plan.size or USUAL_SIZE, USUAL_MAX_DEPTH_M
        net = build_network(model, trust=trust).eval()
    state = folder / "state.pt"
    torch.save(net.state_dict(), state)
    return Subject(
        name=type(net).__name__, model=_without_weights(model), trust=trust, state=state, size=size,
        max_depth_m=max_depth_m, parameters=parameters(net, trainable_only=False), flops=image_flops(net, size),
        merged_flops=image_flops(inference_form(net, size=size), size),
    )  # fmt: skip


def _load(
    checkpoint: str, runs: str, *, trust: list[str], size: tuple[int, int] | None
) -> tuple[nn.Module, dict[str, Any], tuple[int, int], float]:
    """Return network, configuration, size and maximum depth [m]."""
    from hudepth.inference.backends import EXPORTED
    from hudepth.inference.model_info import ModelInfo
    from hudepth.runs.checkpoint import load_checkpoint  # slow to import, and random weights do not need it

    if Path(checkpoint).suffix.lower() in EXPORTED:
        raise ConfigError("checkpoint: exported files are not accepted. Pass the checkpoint or bundle they came from.")
    loaded = load_checkpoint(checkpoint, runs=runs)
    net = loaded.build_net(trust=trust)
    info = ModelInfo.of_checkpoint(loaded, parameters=parameters(net, trainable_only=False), size=size)
    return net, loaded.config["model"], info.size, info.max_depth_m


def _without_weights(model: dict[str, Any]) -> dict[str, Any]:
    """Drop the initial weights from a model's configuration: the tensors come from a file."""
    return {**model, **({"weights": None} if "weights" in model else {})}
