"""Named choices of the models: activations and outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Annotated, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.options import Choice, convert

T = TypeVar("T")

ACTIVATIONS: Mapping[str, Callable[[], nn.Module]] = {"relu": nn.ReLU, "gelu": nn.GELU, "silu": nn.SiLU}
"""Between the two layers of a transformer block's feed-forward part."""

NEAREST_UNIT_DEPTH = 0.01
"""The least depth of the outputs ``log`` and ``bins``: 10 cm at a maximum depth of 10 m."""


class LogDepth(nn.Module):
    """Unit depth between :data:`NEAREST_UNIT_DEPTH` and 1, evenly in its logarithm, giving near depths as much room."""

    def forward(self, x: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return unit depth."""
        return torch.exp(torch.sigmoid(-x.float()) * math.log(NEAREST_UNIT_DEPTH))


class DepthBins(nn.Module):
    """Expected unit depth of a distribution over fixed depths, evenly spaced in the logarithm.

    (Classification as in Cao et al. 2017, and the expectation as in AdaBins, Bhat et al. 2021, without adaption.)
    """

    channels_in = 64
    """Output channels of the last convolution, one per depth."""

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
"""From the last convolution to unit depth. Only sigmoid, log and bins keep it in [0, 1]."""


def choose(key: str, name: str, choices: Mapping[str, T]) -> T:
    """Return ``choices[name]``; raises ConfigError if there is none."""
    return choices[convert(key, name, Annotated[str, Choice(tuple(choices))])]
