"""Optimisers that treat parts of a network differently."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from torch import nn
from torch.optim import AdamW

from hudepth.base.errors import ConfigError

TRUNK = "trunk."
"""Prefix of the parameters of the pretrained part; see :class:`hudepth.models.resnet.ResNet18Trunk`."""


class GroupedAdamW(AdamW):
    """AdamW with a learning rate of its own for the trunk, and no weight decay on biases and norms.

    Groups are named ``trunk``, ``trunk_no_decay``, ``rest`` and ``rest_no_decay``; empty ones are left out.

    Args:
        params: parameters with their names.
        lr: learning rate of all but the trunk.
        trunk_lr_factor: the trunk's learning rate over ``lr``; 0 keeps the trunk as it is.
        weight_decay: of matrices and kernels.
        **options: further arguments of :class:`torch.optim.AdamW`, for example ``fused``.

    Raises:
        ConfigError: for a factor that is negative or not finite.
    """

    def __init__(
        self,
        params: Iterable[tuple[str, nn.Parameter]],
        *,
        lr: float,
        trunk_lr_factor: float = 1.0,
        weight_decay: float = 0.01,
        **options: Any,
    ) -> None:
        if not (math.isfinite(trunk_lr_factor) and trunk_lr_factor >= 0):
            raise ConfigError(f"optim.trunk_lr_factor: {trunk_lr_factor} is not a number of at least 0.")
        groups: dict[str, list[tuple[str, nn.Parameter]]] = {}
        for name, parameter in params:
            part = "trunk" if name.startswith(TRUNK) else "rest"
            groups.setdefault(part if parameter.ndim > 1 else f"{part}_no_decay", []).append((name, parameter))
        super().__init__(
            [
                {
                    "params": members,
                    "name": name,
                    "lr": lr * (trunk_lr_factor if name.startswith("trunk") else 1.0),
                    "weight_decay": 0.0 if name.endswith("_no_decay") else weight_decay,
                }
                for name, members in groups.items()
            ],
            lr=lr,
            **options,
        )
