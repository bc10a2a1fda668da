"""From Hydra's configuration to plain Python: nothing heavy is imported."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from hudepth.base.errors import ConfigError, did_you_mean


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


def size_option(value: Any) -> tuple[int, int] | None:
    """Return ``size`` of a configuration, None where none is typed.

    Raises:
        ConfigError: if it is no [height, width].
    """
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 2 or not all(type(side) is int and side > 0 for side in value):
        raise ConfigError(f"size: {value} is not [height,width]. Pass size=[224,224].")
    return value[0], value[1]


def several(key: str, value: object, choices: Iterable[str]) -> list[str]:
    """Return one or more named choices, each once.

    Raises:
        ConfigError: if there is no such choice, or none is given.
    """
    known = list(choices)
    names = list(dict.fromkeys(str(item) for item in (value if isinstance(value, list) else [value])))
    for name in names:
        if name not in known:
            raise ConfigError(f"{key}: no '{name}'.{did_you_mean(name, known)} Pass some of {', '.join(known)}.")
    if not names:
        raise ConfigError(f"{key}: none is given. Pass some of {', '.join(known)}.")
    return names


def output_folder(value: object) -> Path:
    """Make a folder and try to write to it, before there is anything to lose.

    Raises:
        ConfigError: if that is not possible.
    """
    output = Path(str(value)).expanduser()
    try:
        output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=output):
            return output
    except OSError as error:
        raise ConfigError(f"output: cannot write to '{output}' ({error.strerror}). Pass output=<a folder>.") from error
