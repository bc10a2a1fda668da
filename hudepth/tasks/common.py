"""What the tasks share: from a plain configuration to objects."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from hudepth.data.augment import Augmentation
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.base import Source
from hudepth.errors import ConfigError
from hudepth.instantiate import instantiate
from hudepth.metrics.protocol import Protocol

SOURCE_KEYS = ("root", "encoding")
"""Keys of ``data`` that belong to the source: they stand above it because people type them."""


@contextmanager
def without_known_warnings() -> Iterator[None]:
    """Hide warnings of the libraries that no user can act upon."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*does not have many workers.*")  # reading a store needs none
        warnings.filterwarnings("ignore", ".*exists and is not empty.*")  # the run directory, by design
        warnings.filterwarnings("ignore", ".*LeafSpec.*")  # between Lightning and torch
        warnings.filterwarnings("ignore", ".*in eval mode at the start.*")  # model.trunk_norm=frozen, by design
        for name in ("lightning.pytorch", "lightning.fabric"):
            logging.getLogger(name).setLevel(logging.WARNING)  # their greetings
        yield


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


def build_protocols(protocols: Mapping[str, Any], *, datamodule: DepthDataModule, trust: list[str]) -> list[Protocol]:
    """Build the test protocols of a configuration, in its order.

    Raises:
        ConfigError: if there is none, one cannot be built, or one needs what the data is prepared without.
    """
    built = [instantiate(protocol, trust=trust, only=Protocol) for protocol in protocols.values() if protocol]
    if not built:
        raise ConfigError("protocol: none is given. Pass protocol=paper, protocol=eigen or protocol=[paper,eigen].")
    native = [protocol.name for protocol in built if protocol.needs_native]
    if native and not datamodule.native:
        raise ConfigError(
            f"protocol={native[0]} scores at native resolution, which data.native=false leaves out. "
            "Pass data.native=true, or protocol=paper."
        )
    return built
