"""The parts of a training that a configuration names: built, and checked before it begins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import nn
from torch.optim import Adam, AdamW, Optimizer
from torch.optim.lr_scheduler import LRScheduler

from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.base.instantiate import find_class, has_target, import_trusted, instantiate
from hudepth.data.build import build_data
from hudepth.evaluation.protocols import make_protocols
from hudepth.losses.auxiliary import AuxiliaryHeads
from hudepth.metrics.collection import validation_names
from hudepth.models.build import build_network
from hudepth.runs.checkpoint import find_checkpoint
from hudepth.training.module import loss_name
from hudepth.training.optim import GroupedAdamW
from hudepth.training.options import TrainOptions
from hudepth.training.schedules import StepSchedule


def check_parts(config: Mapping[str, Any], options: TrainOptions) -> None:
    """Build what costs no time, so that a mistake is found before anything is prepared or written.

    Raises ConfigError for parts that cannot be built and metrics that are not logged; CheckpointError if there is no
    checkpoint ``init``.
    """
    trust = options.trust
    import_trusted(trust)
    data = build_data(config["data"], trust=trust, augment=config.get("augment"))
    auxiliary = build_auxiliary(config, trust=trust)
    if auxiliary and data.source.sparse:
        raise ConfigError(
            f"auxiliary: {data.source.name} measures few pixels, and normals and edges need neighbours. "
            "Pass auxiliary=none."
        )
    if not trust:  # else it may be of any kind
        with torch.device("meta"):
            net = build_network({**config["model"], **({"weights": None} if "weights" in config["model"] else {})})
            if auxiliary:
                auxiliary.attach(net)
    if options.test:
        make_protocols(config["protocol"], trust=trust)
    if options.init:
        find_checkpoint(options.init, runs=config["paths"]["runs"], key="init")
    loss, distill = instantiate(config["loss"], trust=trust, only=nn.Module), build_distillation(config, trust=trust)
    optimizer = build_optimizer(config, [("weight", nn.Parameter(torch.zeros(1)))], encoder=None, trust=trust)
    if has_target(config["schedule"]):
        build_schedule(config, optimizer, total_steps=1, trust=trust)
    known = logged_names(loss, training=["distill"] * bool(distill) + list(auxiliary.weights if auxiliary else ()))
    if options.monitor not in known:
        hint = did_you_mean(options.monitor, known)
        raise ConfigError(f"monitor: no '{options.monitor}'.{hint} Pass one of {', '.join(known)}.")


@torch.inference_mode()
def logged_names(loss: nn.Module, *, training: Sequence[str] = ()) -> list[str]:
    """Return the names of everything that is logged for an epoch; calls the loss to learn its terms.

    ``training`` are further terms, which validation does not have. Raises ConfigError if it is no loss of depth maps.
    """
    depth, image = torch.full((1, 1, 16, 16), 0.5), torch.zeros(1, 3, 16, 16)
    try:
        terms = ["total", *loss(depth, depth, image, depth > 0).terms]
    except (TypeError, AttributeError) as error:  # one of torch's own, which takes two tensors and returns one
        why = f"{type(loss).__name__} is not a loss of depth maps ({error})"
        raise ConfigError(f"loss: {why}. Pass loss=l1, or write one as docs/extending.md shows.") from error
    names = [f"val/{name}" for name in validation_names()] + [loss_name("val", term) for term in terms]
    return names + [loss_name("train", term) for term in [*terms, *training]]


def build_optimizer(
    config: Mapping[str, Any],
    parameters: Iterable[tuple[str, nn.Parameter]],
    *,
    encoder: nn.Module | None,
    trust: list[str],
) -> Optimizer:
    """Build the optimiser of a configuration. Raises ConfigError if it cannot be built.

    Of hudepth's own it is told the ``encoder``. ``trust`` lists further modules whose classes may be named.
    """
    optim = dict(config["optim"])
    if optim.get("fused", False) is None:
        del optim["fused"]
        # Others may not take it, and with 16 bits Lightning cannot clip gradients that a fused update unscales.
        if find_class(optim["_target_"], trust=trust) in (Adam, AdamW, GroupedAdamW):
            optim["fused"] = not str(config["trainer"]["precision"]).startswith("16")
    extra = {"encoder": encoder} if str(optim["_target_"]).startswith(f"{GroupedAdamW.__module__}.") else {}
    built: Optimizer = instantiate(optim, parameters, trust=trust, only=Optimizer, key="optim", **extra)
    return built


def build_schedule(
    config: Mapping[str, Any], optimizer: Optimizer, *, total_steps: int, trust: list[str]
) -> LRScheduler:
    """Build the learning-rate schedule of a configuration; arguments and errors as of :func:`build_optimizer`."""
    schedule = config["schedule"]
    own = str(schedule["_target_"]).startswith(f"{StepSchedule.__module__}.")
    extra = {"total_steps": total_steps} if own else {}
    built: LRScheduler = instantiate(schedule, optimizer, trust=trust, only=LRScheduler, key="schedule", **extra)
    return built


def build_distillation(config: Mapping[str, Any], *, trust: list[str]) -> Any:
    """Build the distance from a teacher's depths; None without. Raises ConfigError if there is no teacher."""
    distill = dict(config.get("distill") or {})
    distill.pop("pictures", None)  # like the teacher, read by the data module
    if has_target(distill) and not distill.pop("teacher", None):
        raise ConfigError("distill.teacher is not set. Pass distill.teacher=<folder of depths>, or distill=none.")
    return instantiate(distill, trust=trust, only=nn.Module) if has_target(distill) else None


def build_auxiliary(config: Mapping[str, Any], *, trust: list[str]) -> Any:
    """Build the heads that only training has; None without. Raises ConfigError if they cannot be built."""
    auxiliary = config.get("auxiliary")
    return instantiate(auxiliary, trust=trust, only=AuxiliaryHeads, key="auxiliary") if has_target(auxiliary) else None
