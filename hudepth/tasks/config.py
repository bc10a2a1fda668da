"""From Hydra's configuration to plain Python: nothing heavy is imported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from hudepth.errors import ConfigError


def plain(cfg: DictConfig) -> dict[str, Any]:
    """Resolve a Hydra configuration into dicts, lists and scalars: all that goes below the tasks.

    Raises:
        ConfigError: if a mandatory value is missing.
    """
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        known = {"checkpoint": "file | run directory | last", "input": "image | folder | video | camera"}
        wanted = known.get(missing[0], "value")
        raise ConfigError(f"{missing[0]} is not set. Pass {missing[0]}=<{wanted}>.")
    config = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(config, dict)
    return {str(key): value for key, value in config.items()}


def whole_number(config: Mapping[str, Any], key: str, *, default: int, least: int = 0) -> int:
    """Return a count from a configuration.

    Raises:
        ConfigError: if it is no whole number of at least ``least``.
    """
    value = config.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ConfigError(f"{key}: {value} is no whole number of at least {least}. Leave it out for {default}.")
    return value
