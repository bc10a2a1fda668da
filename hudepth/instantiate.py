"""Turn plain configuration into objects, from trusted modules only.

A configuration may come from a stranger's checkpoint, so a ``_target_`` is not imported unless it lies under a prefix
on the allow-list, and what it names must be a class that was defined there: ``hudepth.files.os.system`` is refused although
its name starts well.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterable, Mapping
from typing import Any

from hudepth.errors import ConfigError, HudepthError, did_you_mean

TRUSTED = ("hudepth.", "torch.nn.", "torch.optim.", "lightning.pytorch.loggers.", "lightning.pytorch.callbacks.")
"""Prefixes of modules whose classes a configuration may name."""


def instantiate(config: Any, *args: Any, trust: Iterable[str] = (), **extra: Any) -> Any:
    """Build what ``config`` describes.

    Args:
        config: plain Python: mappings with a ``_target_`` become objects, other mappings, lists and scalars stay.
        *args: positional arguments of the outermost object, for example an optimiser's parameters.
        trust: further modules whose classes may be named, for example ``["my_package"]``.
        **extra: keyword arguments of the outermost object, over those in ``config``.

    Raises:
        ConfigError: if a target is not trusted, is no class, or does not take its arguments.
    """
    prefixes = (*TRUSTED, *(f"{name.rstrip('.')}." for name in trust))
    return _build(config, prefixes, args, extra)


def _build(config: Any, prefixes: tuple[str, ...], args: tuple[Any, ...] = (), extra: Mapping[str, Any] = {}) -> Any:
    if isinstance(config, list):
        return [_build(item, prefixes) for item in config]
    if not isinstance(config, Mapping):
        return config
    built = {key: _build(value, prefixes) for key, value in config.items() if key != "_target_"}
    if "_target_" not in config:
        return built
    target = _locate(str(config["_target_"]), prefixes)
    arguments = {**built, **extra}
    try:
        inspect.signature(target).bind(*args, **arguments)
    except TypeError as error:
        raise ConfigError(f"{config['_target_']}: {error}.{_suggestion(target, arguments)}") from error
    try:
        return target(*args, **arguments)
    except HudepthError:
        raise
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{config['_target_']}: {error}") from error


def _suggestion(target: type, arguments: Mapping[str, Any]) -> str:
    parameters = [name for name in inspect.signature(target).parameters if name != "self"]
    unknown = [name for name in arguments if name not in parameters]
    return did_you_mean(unknown[0], parameters) or f" It takes {', '.join(parameters)}." if unknown else ""


def _locate(target: str, prefixes: tuple[str, ...]) -> type:
    if not target.startswith(prefixes):
        raise ConfigError(
            f"_target_: '{target}' is not under a trusted module ({', '.join(p.rstrip('.') for p in prefixes)}). "
            f"If it is your own code, pass trust=[{target.split('.')[0]}]."
        )
    module, _, name = target.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError as error:
        raise ConfigError(f"_target_: '{target}' cannot be imported ({error}).") from error
    if not inspect.isclass(found) or not f"{found.__module__}.".startswith(prefixes):
        raise ConfigError(f"_target_: '{target}' is not a class of a trusted module.")
    return found
