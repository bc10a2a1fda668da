"""What the tasks share: from a plain configuration to objects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hudepth.base.errors import ConfigError
from hudepth.base.instantiate import instantiate
from hudepth.data.augment import Augmentation
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.base import Source

SOURCE_KEYS = ("root", "encoding")
"""Keys of ``data`` that belong to the source: they stand above it because people type them."""


def build_data(
    data: Mapping[str, Any], *, trust: list[str], augment: Mapping[str, Any] | None = None
) -> DepthDataModule:
    """Build the data module that the ``data`` part of a configuration describes.

    Args:
        data: the part.
        trust: further modules whose classes may be named.
        augment: the part of that name; only training uses it.

    Raises:
        ConfigError: if it cannot be built.
    """
    if not isinstance(data.get("source"), Mapping):
        raise ConfigError("data.source: none is given. Choose a data set with data=<name>.")
    given = {key: data[key] for key in SOURCE_KEYS if key in data}
    source = instantiate(data["source"], trust=trust, only=Source, **given)
    options = {key: value for key, value in data.items() if key not in (*SOURCE_KEYS, "source")}
    given = {"augment": instantiate(augment, trust=trust, only=Augmentation)} if is_given(augment) else {}
    datamodule: DepthDataModule = instantiate(options, source, trust=trust, only=DepthDataModule, **given)
    return datamodule


def is_given(part: Mapping[str, Any] | None) -> bool:
    """Whether a part of a configuration that may be left out names something to build."""
    return bool(part and part.get("_target_"))
