"""Options, checked once: a dataclass states the type and range of each, and one wording serves every mistake.

A command declares its options, as ``smoothing: Annotated[float, Range(0, 1, below=True)] = 0.0``, and parses its
configuration before any work. A library class checks its arguments in the same words: :func:`check` for a dataclass,
:func:`convert` for one value.
"""

from __future__ import annotations

import math
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from hudepth.base.errors import ConfigError, OptionError, did_you_mean

if TYPE_CHECKING:
    from omegaconf import DictConfig

T = TypeVar("T")


@dataclass(frozen=True)
class Range:
    """Bounds of a number; ``above`` excludes ``min`` itself, ``below`` excludes ``max``."""

    min: float = -math.inf
    max: float = math.inf
    above: bool = False
    below: bool = False

    def holds(self, value: float) -> bool:
        """Return whether a number lies within the bounds."""
        low = value > self.min if self.above else value >= self.min
        return low and (value < self.max if self.below else value <= self.max)

    def __str__(self) -> str:
        low = f"{'above' if self.above else 'of at least'} {self.min:.15g}" if self.min > -math.inf else ""
        high = f"{'below' if self.below else 'at most'} {self.max:.15g}" if self.max < math.inf else ""
        return " and ".join(part for part in (low, high) if part)


@dataclass(frozen=True)
class Choice:
    """Names that a string may be, for choices that are not known to the type checker."""

    names: Sequence[str]


class Broadcast:
    """Marks a tuple for which a single value stands for all: ``size=224`` for ``size=[224,224]``."""


Size = Annotated[tuple[int, int], Range(1), Broadcast(), "[height,width]"]
"""(height, width) in pixels; one number makes a square."""
TrainSize = Annotated[tuple[int, int], Range(1, 2048), Broadcast(), "[height,width] of at most 2048 pixels each"]


def parse(schema: type[T], values: Mapping[str, Any], *, prefix: str = "", strict: bool = False) -> T:
    """Build a dataclass from a configuration.

    Args:
        schema: a dataclass; fields without a default are required.
        values: the configuration; keys that the schema does not have are ignored.
        prefix: of the keys in errors, for example ``trainer.``.
        strict: refuse unknown keys.

    Raises:
        ConfigError: if a key is missing, unknown (``strict``), of the wrong type or out of range.
    """
    defaults = {field.name: _default(field) for field in fields(schema)}  # type: ignore[arg-type]
    if unknown := [key for key in values if strict and key not in defaults]:
        hint = did_you_mean(unknown[0], defaults)
        raise ConfigError(f"{prefix}{unknown[0]}: no such option.{hint} Pass one of {', '.join(defaults)}.")
    result = {}
    for name, hint in _hints(schema).items():
        required = defaults[name] is MISSING
        if required and values.get(name) is None and hint is not Any and type(None) not in get_args(hint):
            raise ConfigError(f"{prefix}{name} is not set. Pass {prefix}{name}=<{_describe(hint)}>.")
        if required or name in values:
            result[name] = convert(f"{prefix}{name}", values.get(name), hint, default=defaults[name])
    return schema(**result)


def check(instance: Any, *, prefix: str) -> None:
    """Check the fields of a dataclass against their annotations and convert them in place; for ``__post_init__``.

    Raises:
        ConfigError: if one is of the wrong type or out of range.
    """
    defaults = {field.name: _default(field) for field in fields(instance)}
    for name, hint in _hints(type(instance)).items():
        value = convert(f"{prefix}{name}", getattr(instance, name), hint, default=defaults[name])
        object.__setattr__(instance, name, value)


def convert(key: str, value: Any, hint: Any, *, default: Any = MISSING) -> Any:
    """Return a value as its type, a scalar as a list or a tuple where that is meant.

    Args:
        key: names the value in errors.
        value: as configured.
        hint: ``bool``, ``int``, ``float``, ``str``, ``Path``, ``Any``, ``Literal``, a list, tuple or mapping of them,
            a dataclass, or any of these with ``| None`` or ``Annotated`` with :class:`Range` or :class:`Choice`.
        default: used if the key is left out.

    Raises:
        ConfigError: if the value does not fit; the message states what was found and what is expected.
    """
    try:
        return _convert(key, value, hint, ())
    except _MismatchError as error:
        fix = did_you_mean(error.args[0], map(str, _choices(hint))) if error.args else ""
        if default is not MISSING and default is not None:
            fix += f" Leave {key} out for {_show(default)}."
        raise OptionError(f"{key}: {_show(value)} is not {_describe(hint)}.{fix}", key) from None


def plain(cfg: DictConfig) -> dict[str, Any]:
    """Resolve a Hydra configuration into dicts, lists and scalars.

    Raises:
        ConfigError: if a mandatory value is missing.
    """
    from omegaconf import OmegaConf

    if missing := sorted(OmegaConf.missing_keys(cfg)):
        what = "file | run directory | last" if missing[0] == "checkpoint" else "value"
        raise ConfigError(f"{missing[0]} is not set. Pass {missing[0]}=<{what}>.")
    config = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(config, dict)
    return {str(key): value for key, value in config.items()}


class _MismatchError(Exception):
    """A value that does not fit its type; its argument is the unknown word, if there is one."""


def _convert(key: str, value: Any, hint: Any, marks: tuple[Any, ...]) -> Any:
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _convert(key, value, args[0], (*args[1:], *marks))
    if origin in (Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        *others, last = (arg for arg in args if arg is not type(None))
        for other in others:
            try:
                return _convert(key, value, other, marks)
            except _MismatchError:
                continue
        return _convert(key, value, last, marks)
    if origin is Literal:
        return _choose(value, args)
    if origin in (list, Sequence):
        converted = [_convert(key, item, args[0], marks) for item in (value if _is_list(value) else [value])]
        if _choices(args[0]):  # each choice once, and at least one
            converted = list(dict.fromkeys(converted))
            if not converted:
                raise _MismatchError
        return converted
    if origin is tuple:
        if any(isinstance(mark, Broadcast) for mark in marks) and not _is_list(value):
            value = [value] * len(args)
        if not _is_list(value) or len(value) != len(args):
            raise _MismatchError
        return tuple(_convert(key, item, arg, marks) for item, arg in zip(value, args, strict=True))
    if isinstance(hint, type) and is_dataclass(hint) and isinstance(value, hint):
        return value
    if origin in (dict, Mapping) or is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise _MismatchError
        if isinstance(hint, type) and is_dataclass(hint):
            return parse(hint, value, prefix=f"{key}.")
        return {name: convert(f"{key}.{name}", each, args[1]) for name, each in value.items()} if args else value
    return _convert_scalar(value, hint, marks)


def _convert_scalar(value: Any, hint: Any, marks: tuple[Any, ...]) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint in (str, Path) and (isinstance(value, str | Path) or number):  # Hydra reads 2011_09_26 as a number
        names = next((mark.names for mark in marks if isinstance(mark, Choice)), None)
        text = str(value) if names is None else _choose(value, names)
        return Path(text).expanduser() if hint is Path else text
    if hint is Any or (hint is bool and isinstance(value, bool)):
        return value
    if number and all(mark.holds(value) for mark in marks if isinstance(mark, Range)):
        if hint is int and isinstance(value, int) and abs(value) < 2**63:
            return value
        if hint is float and abs(value) < math.inf:
            return float(value)
    raise _MismatchError


def _choose(value: Any, names: Sequence[Any]) -> Any:
    if value not in names:
        raise _MismatchError(str(value))
    return value


def _is_list(value: object) -> bool:
    return isinstance(value, list | tuple)


def _choices(hint: Any) -> Sequence[Any]:
    """Return the names a type may be, wherever in it they are stated."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return args
    marked: Iterable[Sequence[Any]] = (arg.names if isinstance(arg, Choice) else _choices(arg) for arg in args)
    return next((names for names in marked if names), ())


def _describe(hint: Any, bounds: str = "") -> str:
    """Describe what a type accepts: ``a whole number of at least 1``."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(_describe(arg, bounds) for arg in args if arg is not type(None))
    if origin is Annotated and (words := next((mark for mark in args[1:] if isinstance(mark, str)), "")):
        return words
    if names := _choices(hint):
        listed = ", ".join(map(str, names))
        return f"{'a list of some' if origin is list else 'one'} of {listed}" if len(names) > 1 else listed
    if origin is Annotated:
        return _describe(args[0], next((f" {mark}" for mark in args[1:] if isinstance(mark, Range)), bounds))
    if origin in (list, Sequence, tuple):
        inner = _describe(args[0], bounds).removeprefix("a ").replace("number", "numbers", 1)
        return f"a list of {f'{len(args)} ' if origin is tuple else ''}{inner}"
    if hint is int or hint is float:
        return f"a {'whole ' if hint is int else ''}number{bounds}"
    return {bool: "true or false", str: "text", Path: "a path"}.get(hint, "a mapping of options")


def _show(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {True: "true", False: "false", None: "null"}[value]
    items = [_show(item).strip("'") for item in value[:100]] if _is_list(value) else []
    text = f"[{','.join(items)}]" if _is_list(value) else f"'{value}'" if isinstance(value, str) else str(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


def _default(field: Any) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


def _hints(schema: Any) -> dict[str, Any]:
    hints = get_type_hints(schema, include_extras=True)
    return {field.name: hints[field.name] for field in fields(schema)}
