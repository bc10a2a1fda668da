"""Named choices of the models: what a string in the configuration stands for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from torch import nn

from hudepth.errors import ConfigError, did_you_mean

T = TypeVar("T")

ACTIVATIONS: Mapping[str, Callable[[], nn.Module]] = {"relu": nn.ReLU, "gelu": nn.GELU, "silu": nn.SiLU}
"""Between the two layers of a transformer block's feed-forward part."""

OUTPUTS: Mapping[str, Callable[[], nn.Module]] = {
    "sigmoid": nn.Sigmoid,
    "relu": nn.ReLU,
    "softplus": nn.Softplus,
    "identity": nn.Identity,
}
"""From the last convolution to unit depth. Only sigmoid keeps it in [0, 1] by itself."""


def choose(key: str, name: str, choices: Mapping[str, T]) -> T:
    """Return ``choices[name]``.

    Raises:
        ConfigError: if there is no such choice; the message names ``key`` and the choices.
    """
    if name not in choices:
        raise ConfigError(f"{key}: no '{name}'.{did_you_mean(name, choices)} Pass one of {', '.join(choices)}.")
    return choices[name]
