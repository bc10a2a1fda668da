"""Optimisers that treat parts of a network differently."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer

from hudepth.base.errors import ConfigError


def fit_state(optimizer: Optimizer) -> None:
    """Lay out the restored state of fused updates as the parameters are: they go through memory without looking.

    Raises ValueError if a part has another shape than its parameter.
    """
    fused = [x for group in optimizer.param_groups if group.get("fused") for x in group["params"]]
    for parameter in fused:
        state = optimizer.state.get(parameter, {})
        for key, value in state.items():
            if not isinstance(value, Tensor) or value.ndim == 0:
                continue
            if value.shape != parameter.shape:
                shapes = " x ".join(map(str, value.shape)), " x ".join(map(str, parameter.shape))
                raise ValueError(f"the optimiser's {key} is {shapes[0]}, its parameter {shapes[1]}")
            if value.stride() != parameter.stride():
                state[key] = torch.empty_like(parameter, dtype=value.dtype).copy_(value)


class GroupedAdamW(AdamW):
    """AdamW with a separate learning rate for the encoder, and no weight decay on biases and norms.

    Groups are named ``encoder``, ``encoder_no_decay``, ``rest`` and ``rest_no_decay``; empty ones are left out.

    ``encoder_lr_factor`` is the encoder's learning rate over ``lr``, finite and not negative, else a ConfigError is
    raised; 0 leaves the encoder unchanged. ``weight_decay`` applies to matrices and kernels. ``options`` are further
    arguments of :class:`torch.optim.AdamW`, as ``fused`` is.
    """

    def __init__(
        self,
        params: Iterable[tuple[str, nn.Parameter]],
        *,
        lr: float,
        encoder: nn.Module | None = None,
        encoder_lr_factor: float = 1.0,
        weight_decay: float = 0.01,
        fused: bool | None = None,
        **options: Any,
    ) -> None:
        if not (math.isfinite(encoder_lr_factor) and encoder_lr_factor >= 0):
            raise ConfigError(f"optim.encoder_lr_factor: {encoder_lr_factor} is not a number of at least 0.")
        inside = set() if encoder is None else {id(parameter) for parameter in encoder.parameters()}
        groups: dict[str, list[tuple[str, nn.Parameter]]] = {}
        for name, parameter in params:
            part = "encoder" if id(parameter) in inside else "rest"
            groups.setdefault(part if parameter.ndim > 1 else f"{part}_no_decay", []).append((name, parameter))
        described: list[dict[str, Any]] = []
        for name, members in groups.items():
            rate = lr * (encoder_lr_factor if name.startswith("encoder") else 1.0)
            decay = 0.0 if name.endswith("_no_decay") else weight_decay
            described.append({"params": members, "name": name, "lr": rate, "weight_decay": decay})
        super().__init__(described, lr=lr, fused=fused, **options)
