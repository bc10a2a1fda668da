"""Test protocols from a configuration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hudepth.base.errors import ConfigError
from hudepth.base.instantiate import has_target, instantiate
from hudepth.data.datamodule import DepthDataModule
from hudepth.metrics.protocol import Protocol


def build_protocols(protocols: Mapping[str, Any], *, datamodule: DepthDataModule, trust: list[str]) -> list[Protocol]:
    """Build test protocols in their order. Raises ConfigError if there is none, or one cannot be built or scored."""
    for name, protocol in protocols.items():
        if protocol and not (isinstance(protocol, Mapping) and has_target(protocol)):
            raise ConfigError(f"protocol.{name}: '{protocol}' is not a protocol. Pass one, as in protocol=eigen.")
    built = [instantiate(protocol, trust=trust, only=Protocol) for protocol in protocols.values() if protocol]
    if not built:
        raise ConfigError("protocol: none is set. Pass protocol=paper, protocol=eigen or protocol=[paper,eigen].")
    native = [protocol.name for protocol in built if protocol.needs_native]
    if native and not datamodule.native:
        why = "scores at native resolution, which data.native=false leaves out"
        raise ConfigError(f"protocol={native[0]} {why}. Pass data.native=true, or protocol=paper.")
    return built
