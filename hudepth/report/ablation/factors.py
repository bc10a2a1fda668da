"""What a sweep varies, found from the configurations of its rows and not from its command line."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hudepth.runs.identity import SEEDS, canonical, identity
from hudepth.viz.style import shorten

TARGET = "_target_"
ABSENT = "-"  # of a row whose configuration has no such key
LONGEST = 40  # letters of a formatted value


@dataclass(frozen=True)
class Factor:
    """One thing that varies."""

    key: str  # dotted, as in config.yaml; that of a class ends in _target_
    name: str  # short, for the head of a column
    values: list[Any]  # a value for each row; None both for null and for rows without the key
    shown: list[str]  # the same, formatted


def variant(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what repetitions of one configuration share: its identity without the seeds."""
    return {key: value for key, value in identity(config).items() if key not in SEEDS}


def variant_key(config: Mapping[str, Any]) -> str:
    """Return a text that repetitions of one configuration share."""
    return json.dumps({key: canonical(value) for key, value in variant(config).items()}, sort_keys=True)


def seed_of(config: Mapping[str, Any]) -> str:
    """Return which repetition a run is: ``1``, or ``1/7`` if the data has another seed than the training."""
    data = config.get("data")
    seeds = [config.get("seed"), data.get("seed") if isinstance(data, Mapping) else None]
    return "/".join(dict.fromkeys(str(seed) for seed in seeds if seed is not None)) or ABSENT


def find_factors(variants: Sequence[Mapping[str, Any]]) -> list[Factor]:
    """Return what differs between rows, each given by its :func:`variant`.

    Options of a class that differs, as of one loss among several, count only if they differ within one class.
    """
    # early_stopping: null becomes early_stopping._target_: null if other rows have a class there
    classes = {key.removesuffix(f".{TARGET}") for row in variants for key in row if _is_target(key)}
    rows = [{f"{key}.{TARGET}" if key in classes else key: value for key, value in row.items()} for row in variants]
    groups = {key: key.removesuffix(f".{TARGET}") for row in rows for key in row}
    groups = {key: group for key, group in groups.items() if _varies(key, rows)}
    times = Counter(group.rpartition(".")[2] for group in groups.values())
    factors = []
    for key, group in groups.items():
        short = group.rpartition(".")[2]
        shown = [format_value(row[key], is_class=_is_target(key)) if key in row else ABSENT for row in rows]
        factors.append(Factor(key, short if times[short] == 1 else group, [row.get(key) for row in rows], shown))
    return factors


def config_differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return every key in which two variants differ, with both values in full."""
    return [
        (key, *(_full(each[key]) if key in each else ABSENT for each in (a, b)))
        for key in dict.fromkeys([*a, *b])
        if (key in a) != (key in b) or canonical(a.get(key)) != canonical(b.get(key))
    ]


def format_value(value: Any, *, is_class: bool = False) -> str:
    """Return a value short enough for a table: classes without their module, files without their folder."""
    text = "none" if value is None else _full(value)
    if isinstance(value, str):
        text = text.rpartition("." if is_class else "/")[2] or text
    return shorten(text, LONGEST)


def _full(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    return json.dumps(value, default=str)


def _is_target(key: str) -> bool:
    return key == TARGET or key.endswith(f".{TARGET}")


def _varies(key: str, rows: Sequence[Mapping[str, Any]]) -> bool:
    """Tell whether ``key`` differs between rows of the same classes, as far as it may be an option of them."""
    parts = key.split(".")[: -2 if _is_target(key) else -1]
    owners = [".".join([*parts[:length], TARGET]) for length in range(1, len(parts) + 1)]
    values: dict[tuple[str, ...], set[str]] = {}
    for row in rows:
        classes = tuple(canonical(row.get(owner)) for owner in owners)
        values.setdefault(classes, set()).add(canonical(row[key]) if key in row else ABSENT)
    return any(len(each) > 1 for each in values.values())
