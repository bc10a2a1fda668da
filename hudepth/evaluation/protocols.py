"""Test protocols from a configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from weakref import WeakSet

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.instantiate import has_target, instantiate
from hudepth.data.datamodule import DepthDataModule
from hudepth.metrics.protocol import Protocol

_TOLD: WeakSet[DepthDataModule] = WeakSet()
"""Data modules that were warned of: a training builds its protocols before and after it."""


def build_protocols(protocols: Mapping[str, Any], *, datamodule: DepthDataModule, trust: list[str]) -> list[Protocol]:
    """Build test protocols in their order. Raises ConfigError if there is none, or one cannot be built or scored.

    Warns, once for a data module, of a protocol that leaves out most of the depths the network predicts: rooms' caps on
    streets.
    """
    built = make_protocols(protocols, trust=trust)
    native = [protocol.name for protocol in built if protocol.needs_native]
    if native and not datamodule.native:
        why = "scores at native resolution, which data.native=false leaves out"
        raise ConfigError(f"protocol={native[0]} {why}. Pass data.native=true, or protocol=paper.")
    _warn_of_caps(built, datamodule)
    return built


def make_protocols(protocols: Mapping[str, Any], *, trust: list[str]) -> list[Protocol]:
    """Build test protocols for any data. Raises ConfigError if there is none, or one cannot be built."""
    for name, protocol in protocols.items():
        if protocol and not (isinstance(protocol, Mapping) and has_target(protocol)):
            raise ConfigError(f"protocol.{name}: '{protocol}' is not a protocol. Pass one, as in protocol=eigen.")
    built = [instantiate(protocol, trust=trust, only=Protocol) for protocol in protocols.values() if protocol]
    if not built:
        raise ConfigError("protocol: none is set. Pass protocol=paper, protocol=eigen or protocol=[paper,eigen].")
    return built


def _warn_of_caps(protocols: Sequence[Protocol], datamodule: DepthDataModule) -> None:
    most = datamodule.max_depth_m
    low = [each for each in protocols if each.max_depth_m is not None and each.max_depth_m < most / 2]
    if not low or datamodule in _TOLD:
        return
    _TOLD.add(datamodule)
    name, cap = low[0].name, low[0].max_depth_m
    text = "protocol=%s scores depths up to %g m, but data.max_depth_m=%g. Pass the set's own, for example %s"
    log.warning(text, name, cap, most, f"protocol=kitti_eigen for KITTI, or protocol.{name}.max_depth_m={most:g}")
