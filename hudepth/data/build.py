"""From a configuration to a data module."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hudepth.base.errors import ConfigError
from hudepth.base.instantiate import has_target, instantiate
from hudepth.data.augment import Augmentation
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.base import Source

# Of the source, but next to it in the configuration: they are often overridden.
_SOURCE_KEYS = ("root", "encoding", "depth_scale_m", "invalid")


def build_data(
    data: Mapping[str, Any], *, trust: list[str], augment: Mapping[str, Any] | None = None
) -> DepthDataModule:
    """Build the data module of a configuration's part ``data``, and ``augment``, which only training uses.

    ``trust`` lists further modules whose classes may be named. Raises ConfigError if it cannot be built.
    """
    if not isinstance(data.get("source"), Mapping):
        raise ConfigError("data.source is not set. Choose a data set with data=<name>.")
    shared = {key: data[key] for key in _SOURCE_KEYS if key in data}
    source = instantiate(data["source"], trust=trust, only=Source, **shared)
    options = {key: value for key, value in data.items() if key not in (*_SOURCE_KEYS, "source")}
    if has_target(augment):
        options["augment"] = instantiate(augment, trust=trust, only=Augmentation)
    datamodule: DepthDataModule = instantiate(options, source, trust=trust, only=DepthDataModule)
    return datamodule
