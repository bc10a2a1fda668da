"""Options as typed, checked once: a dataclass states the type and range of each, and one wording serves every mistake.

A command declares its options and parses its configuration before any work::

    @dataclass(frozen=True)
    class PredictOptions:
        input: str
        formats: list[Annotated[str, Choice(FORMATS)]] | None
        size: Size | None
        smoothing: Annotated[float, Range(0, 1, below=True)] = 0.0

    options = parse(PredictOptions, config)

A library class checks its own arguments in the same words: :func:`check` for a dataclass,
:func:`convert` for one value.
"""

from __future__ import annotations

import math
import tempfile
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from hudepth.base.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from omegaconf import DictConfig

T = TypeVar("T")


@dataclass(frozen=True)
class Range:
    """Bounds of a number, both included unless ``above`` or ``below`` says otherwise."""

    min: float = -math.inf
    max: float = math.inf
    above: bool = False
    """Whether ``min`` itself is left out."""
    below: bool = False
    """Whether ``max`` itself is left out."""

    def holds(self, value: float) -> bool:
        """Tell whether a number lies within the bounds."""
        low = value > self.min if self.above else value >= self.min
        return low and (value < self.max if self.below else value <= self.max)

    def __str__(self) -> str:
        parts = []
        if self.min > -math.inf:
            parts.append(f"{'above' if self.above else 'of at least'} {self.min:.15g}")
        if self.max < math.inf:
            parts.append(f"{'below' if self.below else 'at most'} {self.max:.15g}")
        return " and ".join(parts)


@dataclass(frozen=True)
class Choice:
    """Names that a string may be, for choices that are not known to the type checker."""

    names: Sequence[str]


class Broadcast:
    """Marks a tuple for which a single value stands for all: ``size=224`` for ``size=[224,224]``."""


Size = Annotated[tuple[int, int], Range(1), Broadcast(), "[height,width]"]
"""(height, width) in pixels; one number makes a square."""


def parse(schema: type[T], values: Mapping[str, Any], *, prefix: str = "", strict: bool = False) -> T:
    """Build a dataclass from a configuration.

    Args:
        schema: a dataclass; fields without a default are required.
        values: what was configured; keys that the schema does not have are ignored.
        prefix: of the keys in errors, for example ``trainer.``.
        strict: refuse unknown keys.

    Raises:
        ConfigError: if a key is missing, unknown (``strict``), of the wrong type or out of range.
    """
    known = {field.name: field for field in fields(schema)}  # type: ignore[arg-type]
    if unknown := [key for key in values if strict and key not in known]:
        hint = did_you_mean(unknown[0], known)
        raise ConfigError(f"{prefix}{unknown[0]}: no such option.{hint} Pass one of {', '.join(known)}.")
    result = {}
    for name, hint in _hints(schema).items():
        default = _default(known[name])
        if default is MISSING and values.get(name) is None and hint is not Any and type(None) not in get_args(hint):
            raise ConfigError(f"{prefix}{name} is not set. Pass {prefix}{name}=<{_describe(hint)}>.")
        if name in values or default is MISSING:
            result[name] = convert(f"{prefix}{name}", values.get(name), hint, default=default)
    return schema(**result)


def check(instance: Any, *, prefix: str) -> None:
    """Check the fields of a dataclass against their annotations, and convert them in place; for ``__post_init__``.

    Raises:
        ConfigError: if one is of the wrong type or out of range.
    """
    known = {field.name: field for field in fields(instance)}
    for name, hint in _hints(type(instance)).items():
        value = convert(f"{prefix}{name}", getattr(instance, name), hint, default=_default(known[name]))
        object.__setattr__(instance, name, value)


def convert(key: str, value: Any, hint: Any, *, default: Any = MISSING) -> Any:
    """Return a value as its type, the scalar as a list or a tuple where that is meant.

    Args:
        key: names the value in errors.
        value: as typed.
        hint: ``bool``, ``int``, ``float``, ``str``, ``Path``, ``Any``, ``Literal``, a list, tuple or mapping of them,
            a dataclass, or any of these with ``| None`` or ``Annotated`` with :class:`Range` or :class:`Choice`.
        default: what leaving the key out stands for.

    Raises:
        ConfigError: if the value is none of that; the message says what was found and what is expected.
    """
    try:
        return _convert(key, value, hint, ())
    except _MismatchError as error:
        word = error.args[0] if error.args else None
        raise ConfigError(f"{key}: {_show(value)} is not {_describe(hint)}.{_fix(key, hint, word, default)}") from None


def plain(cfg: DictConfig) -> dict[str, Any]:
    """Resolve a Hydra configuration into dicts, lists and scalars.

    Raises:
        ConfigError: if a mandatory value is missing.
    """
    from omegaconf import OmegaConf

    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        known = {"checkpoint": "file | run directory | last", "input": "image | folder | video | camera"}
        raise ConfigError(f"{missing[0]} is not set. Pass {missing[0]}=<{known.get(missing[0], 'value')}>.")
    config = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(config, dict)
    return {str(key): value for key, value in config.items()}


def output_folder(value: str | Path, *, key: str = "output") -> Path:
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
        raise ConfigError(f"{key}: cannot write to '{output}' ({error.strerror}). Pass {key}=<a folder>.") from error


class _MismatchError(Exception):
    """A value that is not of its type; its argument is the word that was not known, if it is one."""


def _convert(key: str, value: Any, hint: Any, marks: tuple[Any, ...]) -> Any:
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _convert(key, value, args[0], (*args[1:], *marks))
    if origin in (Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        return _convert_any(key, value, [arg for arg in args if arg is not type(None)], marks)
    if origin is Literal:
        return _choose(value, args)
    if origin in (list, Sequence):
        items = value if isinstance(value, list | tuple) else [value]
        converted = [_convert(key, item, args[0], marks) for item in items]
        if _choices(args[0]):  # each choice once, and at least one
            converted = list(dict.fromkeys(converted))
            if not converted:
                raise _MismatchError
        return converted
    if origin is tuple:
        return _convert_tuple(key, value, args, marks)
    if origin in (dict, Mapping):
        if not isinstance(value, Mapping):
            raise _MismatchError
        return value
    if is_dataclass(hint) and isinstance(hint, type):
        if isinstance(value, hint):
            return value
        if not isinstance(value, Mapping):
            raise _MismatchError
        return parse(hint, value, prefix=f"{key}.")
    return _convert_scalar(value, hint, marks)


def _convert_any(key: str, value: Any, hints: Sequence[Any], marks: tuple[Any, ...]) -> Any:
    for hint in hints[:-1]:
        try:
            return _convert(key, value, hint, marks)
        except _MismatchError:
            continue
    return _convert(key, value, hints[-1], marks)


def _convert_tuple(key: str, value: Any, args: tuple[Any, ...], marks: tuple[Any, ...]) -> Any:
    if any(isinstance(mark, Broadcast) for mark in marks) and not isinstance(value, list | tuple):
        value = [value] * len(args)
    if not isinstance(value, list | tuple) or len(value) != len(args):
        raise _MismatchError
    return tuple(_convert(key, item, arg, marks) for item, arg in zip(value, args, strict=True))


def _convert_scalar(value: Any, hint: Any, marks: tuple[Any, ...]) -> Any:
    if hint is Any:
        return value
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint in (str, Path):  # Hydra reads what looks like a number as one
        if not (isinstance(value, str | Path) or number):
            raise _MismatchError
        names = next((mark.names for mark in marks if isinstance(mark, Choice)), None)
        text = str(value) if names is None else _choose(value, names)
        return Path(text).expanduser() if hint is Path else text
    if hint is bool and isinstance(value, bool):
        return value
    if hint is int and number and isinstance(value, int) and _within(value, marks):
        return value
    if hint is float and number and math.isfinite(value) and _within(value, marks):
        return float(value)
    raise _MismatchError


def _within(value: float, marks: Iterable[Any]) -> bool:
    return all(mark.holds(value) for mark in marks if isinstance(mark, Range))


def _choose(value: Any, names: Sequence[str]) -> Any:
    if value not in names:
        raise _MismatchError(str(value))
    return value


def _choices(hint: Any) -> Sequence[str]:
    """Return the names a type may be, wherever in it they are stated."""
    if get_origin(hint) is Literal:
        return get_args(hint)
    if get_origin(hint) is Annotated:
        marked = next((mark.names for mark in get_args(hint)[1:] if isinstance(mark, Choice)), None)
        return marked or _choices(get_args(hint)[0])
    return next((names for arg in get_args(hint) if (names := _choices(arg))), ())


def _describe(hint: Any, bounds: str = "") -> str:
    """Say what a type accepts: ``a whole number of at least 1``."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        if words := next((mark for mark in args[1:] if isinstance(mark, str)), ""):
            return words
        if names := _choices(hint):
            return f"one of {', '.join(map(str, names))}"
        return _describe(args[0], next((f" {mark}" for mark in args[1:] if isinstance(mark, Range)), bounds))
    if origin in (Union, types.UnionType):
        return " or ".join(_describe(arg, bounds) for arg in args if arg is not type(None))
    if names := _choices(hint):
        return f"{'a list of some' if origin is list else 'one'} of {', '.join(map(str, names))}"
    if origin in (list, Sequence, tuple):
        inner = _describe(args[0], bounds).removeprefix("a ")
        count = f"{len(args)} " if origin is tuple else ""
        return f"a list of {count}{inner.replace('number', 'numbers', 1)}"
    if hint is int or hint is float:
        return f"a {'whole ' if hint is int else ''}number{bounds}"
    return {bool: "true or false", str: "text", Path: "a path"}.get(hint, "a group of options")


def _fix(key: str, hint: Any, word: str | None, default: Any) -> str:
    suggestion = did_you_mean(word, map(str, _choices(hint))) if word else ""
    if default is MISSING:
        return suggestion
    return f"{suggestion} Leave {key} out for {'the default' if default is None else _show(default)}."


def _show(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(str(_show(item)).strip(chr(39)) for item in value)}]"
    return f"'{value}'" if isinstance(value, str) else str(value)


def _default(field: Any) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


def _hints(schema: Any) -> dict[str, Any]:
    hints = get_type_hints(schema, include_extras=True)
    return {field.name: hints[field.name] for field in fields(schema)}


# Replaced by parse() and convert(); each goes with its last caller.


def whole_number(config: Mapping[str, Any], key: str, *, default: int, least: int = 0) -> int:
    """Return a count from a configuration.

    Raises:
        ConfigError: if it is not a whole number of at least ``least``.
    """
    number: int = convert(key, config.get(key, default), Annotated[int, Range(least)], default=default)
    return number


def size_option(value: Any) -> tuple[int, int] | None:
    """Return ``size`` of a configuration, None where none is typed.

    Raises:
        ConfigError: if it is not [height, width].
    """
    size: tuple[int, int] | None = convert("size", value, Size | None)
    return size


def several(key: str, value: object, choices: Iterable[str]) -> list[str]:
    """Return one or more named choices, each once.

    Raises:
        ConfigError: if there is no such choice, or none is given.
    """
    names: list[str] = convert(key, value, list[Annotated[str, Choice(tuple(choices))]])
    return names
