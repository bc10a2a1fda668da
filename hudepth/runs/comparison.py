"""Which test results may be compared (those of one protocol, data and split), and what they have in common."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from hudepth.base.errors import DataError, did_you_mean
from hudepth.metrics.summary import ImageTable
from hudepth.runs.identity import flat
from hudepth.runs.results import Result


def stamp_differences(a: Result, b: Result) -> list[str]:
    """Return what prevents comparing two results, for example ``protocol.crop: [45,471,41,601] against none``.

    Compared are all values of the protocol; source, fingerprint and encoding of the data; kind and sha256 of the
    split; and, for protocols that score at network resolution, size and maximum depth, which define the ground truth.
    """
    before, after = _conditions(a), _conditions(b)
    changed = [key for key in dict.fromkeys([*before, *after]) if before.get(key) != after.get(key)]
    return [f"{key}: {_format(before.get(key))} against {_format(after.get(key))}" for key in changed]


def _conditions(result: Result) -> dict[str, Any]:
    conditions = flat(result.stamp, "protocol.")
    if result.stamp.get("resolution") == "network":
        conditions |= {key: result.document.get(key) for key in ("network_size", "max_depth_m")}
    conditions |= {f"data.{key}": result.data.get(key) for key in ("source", "fingerprint", "encoding")}
    return conditions | {f"split.{key}": result.split.get(key) for key in ("kind", "sha256")}


def _format(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, str):
        return value[:8] if len(value) == 64 else value  # a sha256
    return json.dumps(value, separators=(",", ":"))


def paired(a: Result, b: Result) -> tuple[ImageTable, ImageTable]:
    """Return the images of two results, in the order of the first; their splits may differ in the training pairs.

    Raises DataError if protocol, data or images differ.
    """
    where = _check_conditions(a, b)
    first, second = _take_common(a.table, b.table)
    count, others, shared = len(a.table.ids), len(b.table.ids), len(first.ids)
    if not count == others == shared:
        raise DataError(
            f"{where} were tested on different images: {count} of split {a.split['kind']} and {others} of split "
            f"{b.split['kind']}, {shared} of them in both. Compare runs of one data.split, or test both on data that "
            "neither was trained on: hudepth-test checkpoint=<run> data=<name>."
        )
    if first.scenes != second.scenes or not np.array_equal(first.pixels, second.pixels):
        differ = "have different scenes or pixel counts for the same images"
        raise DataError(f"{where} {differ}. Run hudepth-test on both again.")
    return a.table, second


def common_images(a: Result, b: Result) -> tuple[ImageTable, ImageTable]:
    """Return the images that are in both results, in the order of the first; for two splits of one data set.

    Raises DataError if protocol or data differ, or if they share no image.
    """
    where = _check_conditions(a, b)
    tables = _take_common(a.table, b.table)
    if not tables[0].ids:
        raise DataError(f"{where} share no test image. Compare splits of one data set.")
    return tables


def _check_conditions(a: Result, b: Result) -> str:
    """Refuse different data or protocols; return both paths, for messages."""
    where = f"'{a.path}' and '{b.path}'"
    lines = [line for line in stamp_differences(a, b) if not line.startswith("split.")]
    if data := [line for line in lines if line.startswith("data.")]:
        raise DataError(
            f"{where} were tested on different data ({'; '.join(data)}), so their images cannot be paired. "
            "Test both on one data set: hudepth-test checkpoint=<run> data=<name>."
        )
    if lines:
        fix = "Run hudepth-test on both again with the same settings."
        raise DataError(f"{where} were tested under different protocols ({_first(lines)}). {fix}")
    return where


def _take_common(a: ImageTable, b: ImageTable) -> tuple[ImageTable, ImageTable]:
    position = {image: row for row, image in enumerate(b.ids)}
    rows = [row for row, image in enumerate(a.ids) if image in position]
    return _take(a, rows), _take(b, [position[a.ids[row]] for row in rows])


def _take(table: ImageTable, rows: Sequence[int]) -> ImageTable:
    return replace(
        table,
        ids=[table.ids[row] for row in rows],
        scenes=[table.scenes[row] for row in rows],
        categories=[table.categories[row] for row in rows],
        pixels=table.pixels[list(rows)],
        values={name: values[list(rows)] for name, values in table.values.items()},
    )


def merge(results: Mapping[str, Result], *, metrics: Sequence[str], mark: bool = False) -> list[dict[str, str | float]]:
    """Return the rows of a table, one per result: ``name``, then the metrics of its network, NaN where it lacks one.

    Where protocols, data or splits differ, ``mark`` adds the columns ``protocol``, ``data`` and ``split`` as needed to
    tell the rows apart. Raises DataError if they differ and it is not set, or if no result has a metric.
    """
    known = {name for result in results.values() for name in result.metrics}
    for name in metrics:
        if name not in known:
            raise DataError(f"no result has a metric '{name}'.{did_you_mean(name, known)}")
    marks = _marks(results)
    if marks and not mark:
        (name, first), *others = results.items()
        other, lines = next((n, lines) for n, r in others if (lines := stamp_differences(first, r)))
        raise DataError(
            f"the results of '{name}' and '{other}' do not compare: {_first(lines)}. "
            "Run hudepth-test on them again with the same settings, or mark in the table what differs."
        )
    rows: list[dict[str, str | float]] = []
    for name, result in results.items():
        known_values = {metric: result.metrics.get(metric, math.nan) for metric in metrics}
        rows.append({"name": name, **{column: words[name] for column, words in marks.items()}, **known_values})
    return rows


def _marks(results: Mapping[str, Result]) -> dict[str, dict[str, str]]:
    """Return which of protocol, data and split differ, and a text for each result that tells it apart."""
    conditions = {name: _conditions(result) for name, result in results.items()}
    pairs = list(combinations(conditions.values(), 2))
    marks: dict[str, dict[str, str]] = {}
    for column, main in (("protocol", "protocol.name"), ("data", "data.source"), ("split", "split.kind")):
        keys = dict.fromkeys(key for each in conditions.values() for key in each)
        # what differs between results of the same name is added to the name
        own = [k for k in keys if column == (k.partition(".")[0] if k.startswith(("data.", "split.")) else "protocol")]
        more = [k for k in own if any(x[main] == y[main] and x.get(k) != y.get(k) for x, y in pairs)]
        if more or any(x[main] != y[main] for x, y in pairs):
            for name, x in conditions.items():
                details = (f"{k.partition('.')[2] or k} {_format(x[k])}" for k in more if k in x)
                marks.setdefault(column, {})[name] = ", ".join([str(x[main]), *details])
    return marks


def _first(lines: Sequence[str]) -> str:
    more = f"; {len(lines) - 3} more" if len(lines) > 3 else ""
    return "; ".join(lines[:3]) + more
