"""Build the network that a configuration or a checkpoint names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import nn

from hudepth.base.errors import ConfigError
from hudepth.base.instantiate import find_class, instantiate

OWN = __package__
"""Where hudepth's networks are defined."""


def build_network(model: Mapping[str, Any], *, trust: Sequence[str] = ()) -> nn.Module:
    """Build the network of a configuration's part ``model``: one of hudepth's, or with ``trust`` one of those packages.

    Raises ConfigError if it is another class, or does not take its arguments.
    """
    target = str(model.get("_target_"))
    if not trust and not find_class(target).__module__.startswith(f"{OWN}."):
        raise ConfigError(f"model: '{target}' is no depth network of hudepth. Pass trust=[<package>] to build others.")
    net: nn.Module = instantiate(dict(model), trust=trust, only=object if trust else nn.Module, key="model")
    return net
