"""The network that hudepth-bench measures: that of a checkpoint, or a model with random weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import nn

from hudepth.base.errors import ConfigError
from hudepth.base.instantiate import instantiate
from hudepth.base.options import size_option
from hudepth.bench.field import Subject
from hudepth.bench.torch_runners import operations, parameters
from hudepth.models.inference import inference_form

USUAL_SIZE, USUAL_MAX_DEPTH_M = (224, 224), 10.0
"""Of a model that no checkpoint says it of."""


def make_subject(config: dict[str, Any], folder: Path) -> Subject:
    """Return what is to be measured; its tensors are written to ``folder``.

    Args:
        config: of hudepth-bench.
        folder: that exists.

    Raises:
        HudepthError: if there is no such checkpoint, or the network cannot be built or does not take the size.
    """
    size, trust = size_option(config["size"]), [str(name) for name in config["trust"]]
    spec, model = config["checkpoint"], config.get("model")
    if (spec is None) == (model is None):
        what = "both are set" if model is not None else "neither is set"
        raise ConfigError(f"checkpoint, model: {what}. Pass checkpoint=<file | run directory | last> or model=<name>.")
    if spec is not None:
        net, model, size, max_depth_m = _of_checkpoint(str(spec), config, trust=trust, size=size)
    else:
        torch.manual_seed(0)
        net = instantiate(_without_weights(model), trust=trust, only=object if trust else nn.Module).eval()
        size, max_depth_m = size or USUAL_SIZE, USUAL_MAX_DEPTH_M
    state = folder / "state.pt"
    torch.save(net.state_dict(), state)
    return Subject(
        name=type(net).__name__, model=_without_weights(model), trust=trust, state=state, size=size,
        max_depth_m=max_depth_m, parameters=parameters(net), flops=operations(net, size),
        merged_flops=operations(inference_form(net, size=size), size),
    )  # fmt: skip


def _of_checkpoint(
    spec: str, config: dict[str, Any], *, trust: list[str], size: tuple[int, int] | None
) -> tuple[nn.Module, dict[str, Any], tuple[int, int], float]:
    """Return network, its configuration, size and what unit depth 1 stands for."""
    from hudepth.inference.backends import EXPORTED, info_of
    from hudepth.runs.checkpoint import load_checkpoint  # takes seconds, which random weights need not wait for

    if Path(spec).suffix.lower() in EXPORTED:
        raise ConfigError("checkpoint: exported files are made here. Pass the checkpoint or bundle it came from.")
    checkpoint = load_checkpoint(spec, runs=config["paths"]["runs"])
    net = checkpoint.build_net(trust=trust)
    info = info_of(checkpoint, parameters=parameters(net), size=size)
    return net, checkpoint.config["model"], info.size, info.max_depth_m


def _without_weights(model: Any) -> dict[str, Any]:
    """Return a model's configuration without what it starts from: its tensors are given."""
    return {**model, **({"weights": None} if "weights" in model else {})}
