"""Turn plain configuration into objects, from trusted modules only.

A configuration may come from an untrusted checkpoint, so a ``_target_`` is not imported unless it lies under a prefix
on the allow-list, and what it names must be a class that was defined there: ``hudepth.base.files.os.system`` is refused
although its name starts well.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, cast

from hudepth.base.errors import ConfigError, HudepthError, did_you_mean, first_line
from hudepth.base.options import Range, convert

TRUSTED = (
    "hudepth.", "torch.nn.modules.loss.", "torch.optim.", "lightning.pytorch.loggers.", "lightning.pytorch.callbacks.",
)  # fmt: skip
"""Prefixes of modules whose classes a configuration may name: of torch.nn only losses, since nn.LSTM(num_layers=10**8)
would never be built."""
_NUMBER = {"bool", "int", "float", "None", "Optional", "Union", "typing", "Tensor", "torch"}
"""Words of the annotation of an argument that is a number or a switch."""
_NOT_NEGATIVE = {"lr", "weight_decay", "momentum", "eps"}
"""Arguments of PyTorch's optimisers, which refuse negative ones without saying whose they are."""
_IMPORTED = ("torch.nn.",)
"""Prefixes under which classes of :data:`TRUSTED` are usually named: torch.nn.L1Loss."""


def instantiate(
    config: Any, *args: Any, trust: Iterable[str] = (), only: type = object, key: str = "", **extra: Any
) -> Any:
    """Build what ``config`` describes.

    Args:
        config: plain Python: mappings with a ``_target_`` become objects, other mappings, lists and scalars stay.
        *args: positional arguments of the outermost object, for example an optimiser's parameters.
        trust: further modules whose classes may be named, for example ``["my_package"]``.
        only: every class named, also a nested one, must be of this kind: what an untrusted configuration builds where
            a network is expected should not be something that writes files.
        key: names the outermost object in errors about its numbers: ``optim``.
        **extra: keyword arguments of the outermost object, over those in ``config``.

    Raises:
        ConfigError: if a target is not trusted, is no such class, or does not take its arguments.
    """
    prefixes = _prefixes(trust)
    if key and has_target(config):
        _check_numbers(_locate(str(config["_target_"]), prefixes), config, key)
    return _build(config, prefixes, only, args, extra)


def _check_numbers(target: type, config: Mapping[str, Any], key: str) -> None:
    """Check what a class says are numbers or switches: PyTorch's often notice other values in the first step only."""
    try:
        parameters = inspect.signature(target).parameters
    except ValueError:  # a class of C code
        return
    for name in parameters.keys() & config.keys():
        # As text, since it may name what its module did not import.
        words = set(re.findall(r"\w+", inspect.formatannotation(parameters[name].annotation)))
        kind = next((each for each in (float, int, bool) if each.__name__ in words), None)
        left_out = config[name] is None and words & {"None", "Optional"}
        if kind and words <= _NUMBER and not left_out:
            hint: Any = Annotated[kind, Range(0)] if name in _NOT_NEGATIVE else kind
            convert(f"{key}.{name}", config[name], hint)


def find_class(target: str, *, trust: Iterable[str] = ()) -> type:
    """Import the class that a ``_target_`` names.

    Raises:
        ConfigError: if it is not trusted, or there is no such class.
    """
    return _locate(target, _prefixes(trust))


def _prefixes(trust: Iterable[str]) -> tuple[str, ...]:
    return (*TRUSTED, *(f"{name.rstrip('.')}." for name in trust))


def has_target(config: Mapping[str, Any] | None) -> bool:
    """Return whether an optional part of a configuration describes something to build."""
    return bool(config and config.get("_target_"))


def import_trusted(trust: Iterable[str]) -> None:
    """Import the packages that the user trusts, so that they can register their metrics.

    Raises:
        ConfigError: if one cannot be imported.
    """
    for name in trust:
        try:
            importlib.import_module(name.rstrip("."))
        except ImportError as error:
            raise ConfigError(
                f"trust: '{name}' cannot be imported ({error}). Pass trust=[<an installed package>]."
            ) from error


def _build(
    config: Any, prefixes: tuple[str, ...], only: type, args: tuple[Any, ...] = (), extra: Mapping[str, Any] = {}
) -> Any:
    if isinstance(config, list):
        return [_build(item, prefixes, only) for item in config]
    if not isinstance(config, Mapping):
        return config
    built = {key: _build(value, prefixes, only) for key, value in config.items() if key != "_target_"}
    if "_target_" not in config:
        return built
    target = _locate(str(config["_target_"]), prefixes)
    if not issubclass(target, only):
        raise ConfigError(f"_target_: '{config['_target_']}' is no {only.__name__}, which is what belongs here.")
    arguments = {**built, **extra}
    try:
        inspect.signature(target).bind(*args, **arguments)
    except (TypeError, ValueError) as error:  # ValueError: a class of C code that does not tell what it takes
        raise ConfigError(f"{config['_target_']}: {error}.{_suggestion(target, arguments)}") from error
    try:
        return target(*args, **arguments)
    except HudepthError:
        raise
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:  # RuntimeError: torch, of sizes
        raise ConfigError(f"{config['_target_']}: {first_line(error)}") from error


def _suggestion(target: type, arguments: Mapping[str, Any]) -> str:
    try:
        parameters = list(inspect.signature(target).parameters)
    except ValueError:
        return ""
    unknown = [name for name in arguments if name not in parameters]
    if not unknown:
        return ""
    return did_you_mean(unknown[0], parameters) or f" It takes {', '.join(parameters) or 'no arguments'}."


def _locate(target: str, prefixes: tuple[str, ...]) -> type:
    if not target.startswith((*prefixes, *_IMPORTED)):
        raise ConfigError(
            f"_target_: '{target}' is not under a trusted module ({', '.join(p.rstrip('.') for p in prefixes)}). "
            f"If it is your own code, pass trust=[{target.split('.')[0]}]."
        )
    module_name, _, name = target.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(f"_target_: '{target}' cannot be imported ({error}).") from error
    found = getattr(module, name, None)
    if not _is_trusted(found, prefixes):
        classes = [key for key, value in vars(module).items() if _is_trusted(value, prefixes)]
        fix = did_you_mean(name, classes)
        if inspect.isclass(found) and target.startswith(_IMPORTED):
            fix += f" If you want it built, pass trust=[{module_name}]."
        raise ConfigError(f"_target_: '{target}' is not a class of a trusted module.{fix}")
    return cast(type, found)


def _is_trusted(value: object, prefixes: tuple[str, ...]) -> bool:
    return inspect.isclass(value) and f"{value.__module__}.".startswith(prefixes)
