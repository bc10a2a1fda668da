"""Named choices of the models: what a string in the configuration stands for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.errors import ConfigError, did_you_mean

T = TypeVar("T")

ACTIVATIONS: Mapping[str, Callable[[], nn.Module]] = {"relu": nn.ReLU, "gelu": nn.GELU, "silu": nn.SiLU}
"""Between the two layers of a transformer block's feed-forward part."""

NEAREST_UNIT_DEPTH = 0.01
"""What the outputs ``log`` and ``bins`` begin with: 10 cm where the unit is 10 m."""


class LogDepth(nn.Module):
    """Unit depth between :data:`NEAREST_UNIT_DEPTH` and 1, evenly in its logarithm: near depths get as much room."""

    def forward(self, x: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return unit depth."""
        return torch.exp(torch.sigmoid(-x.float()) * math.log(NEAREST_UNIT_DEPTH))


class DepthBins(nn.Module):
    """Expected unit depth of a distribution over fixed depths, which are evenly spaced in the logarithm.

    (Classification as in Cao et al. 2017, and the expectation as in AdaBins, Bhat et al. 2021, without adaption.)
    """

    channels_in = 64
    """How many channels the last convolution must have: one for each depth."""

    centres: Tensor

    def __init__(self) -> None:
        super().__init__()
        centres = torch.logspace(math.log10(NEAREST_UNIT_DEPTH), 0, self.channels_in, dtype=torch.float64)
        self.register_buffer("centres", centres.float(), persistent=False)

    def forward(self, x: Float[Tensor, "b bins h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return unit depth."""
        return torch.einsum("bkhw,k->bhw", x.float().softmax(dim=1), self.centres.float())[:, None]


OUTPUTS: Mapping[str, Callable[[], nn.Module]] = {
    "sigmoid": nn.Sigmoid,
    "relu": nn.ReLU,
    "softplus": nn.Softplus,
    "identity": nn.Identity,
    "log": LogDepth,
    "bins": DepthBins,
}
"""From the last convolution to unit depth. Only sigmoid, log and bins keep it in [0, 1] by themselves."""


def choose(key: str, name: str, choices: Mapping[str, T]) -> T:
    """Return ``choices[name]``.

    Raises:
        ConfigError: if there is no such choice; the message names ``key`` and the choices.
    """
    if name not in choices:
        raise ConfigError(f"{key}: no '{name}'.{did_you_mean(name, choices)} Pass one of {', '.join(choices)}.")
    return choices[name]
