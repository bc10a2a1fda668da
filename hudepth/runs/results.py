"""Results of hudepth-test: how to find, read and compare what it wrote.

A number means something only beside the protocol, the data and the split it was got with, so two results are put side
by side only where these agree, or with what differs beside them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from hudepth.base.errors import DataError, did_you_mean
from hudepth.metrics.summary import ImageTable, read_per_image, summarise
from hudepth.runs.identity import flat

METRICS, PER_IMAGE = "metrics.json", "per_image.csv"
MODEL = "model"
"""Name of the network among the predictors of metrics.json."""
CHECKED = ("abs_rel", "rmse")
"""Metrics by which per_image.csv is known to belong to metrics.json."""


@dataclass(frozen=True)
class Result:
    """What hudepth-test wrote about one checkpoint under one protocol."""

    path: Path
    """The folder of metrics.json."""
    document: dict[str, Any]
    """metrics.json."""
    table: ImageTable
    """per_image.csv."""

    @property
    def stamp(self) -> dict[str, Any]:
        """The protocol, as :meth:`hudepth.metrics.protocol.Protocol.stamp` states it."""
        return dict(self.document["protocol"])

    @property
    def protocol_name(self) -> str:
        """The protocol's name."""
        return str(self.stamp["name"])

    @property
    def data(self) -> dict[str, Any]:
        """Source, fingerprint and encoding of the data, and more."""
        return dict(self.document["data"])

    @property
    def split(self) -> dict[str, Any]:
        """Kind, seed, fractions, counts and sha256 of the split."""
        return dict(self.document["split"])

    @property
    def metrics(self) -> dict[str, float]:
        """The network's metrics; NaN where the file says null."""
        return {k: math.nan if v is None else float(v) for k, v in self.document["metrics"][MODEL].items()}

    @property
    def averaging(self) -> dict[str, Any]:
        """What :func:`hudepth.metrics.summary.summarise` and the bootstrap need to know of the protocol."""
        silog = self.stamp["silog"]
        return {
            "averaging": self.stamp["averaging"],
            "silog_lambda": float(silog["lambda"]),
            "silog_factor": float(silog["factor"]),
        }


def find_result(run_or_folder: str | Path, protocol: str) -> Result:
    """Read a result.

    Args:
        run_or_folder: a run directory, a study's folder, the folder ``test`` in them (or another that hudepth-test
            was told to write to), or the folder of the protocol itself.
        protocol: its name.

    Raises:
        DataError: if there is none, or its files are damaged or do not belong together.
    """
    folder = Path(run_or_folder).expanduser()
    places = [folder / "test" / protocol, folder / protocol, folder]
    found = next((place for place in places if (place / METRICS).is_file()), None)
    if not folder.is_dir():
        raise DataError(f"no folder '{folder}'. Pass a run directory or a folder of test results.")
    if found is None:
        others = {
            file.parent.name for pattern in (f"test/*/{METRICS}", f"*/{METRICS}") for file in folder.glob(pattern)
        }
        there = f" It holds {', '.join(sorted(others))}.{did_you_mean(protocol, others)}" if others else ""
        raise DataError(
            f"'{folder}' holds no test result of protocol '{protocol}'.{there} "
            f"Run hudepth-test checkpoint={folder} protocol={protocol}."
        )
    result = _read(found)
    if result.protocol_name != protocol:
        raise DataError(
            f"'{found}' is a test result of protocol '{result.protocol_name}', not of '{protocol}'. "
            f"Pass protocol={result.protocol_name}."
        )
    return result


def _read(folder: Path) -> Result:
    path = folder / METRICS
    again = "Run hudepth-test again."
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"'{path}' cannot be read ({error}). {again}") from error
    lacking = next((key for key in _NEEDED if not _has(document, key)), None)
    if lacking:
        raise DataError(f"'{path}' is no test result: it has no {lacking}. {again}")
    if not (folder / PER_IMAGE).is_file():
        raise DataError(f"'{folder}' has a {METRICS} but no {PER_IMAGE}. {again}")
    result = Result(path=folder, document=document, table=read_per_image(folder / PER_IMAGE))
    try:
        metrics, averaging = result.metrics, result.averaging
    except (AttributeError, TypeError, ValueError) as error:
        raise DataError(f"'{path}' is no test result ({error}). {again}") from error
    if len(result.table.ids) != document["images"]:
        raise DataError(
            f"'{folder / PER_IMAGE}' holds {len(result.table.ids)} images, but {METRICS} beside it speaks of "
            f"{document['images']}. {again}"
        )
    means = summarise(result.table, **averaging)
    for name in CHECKED:
        stated, got = metrics.get(name, math.nan), means.get(name, math.nan)
        if math.isfinite(stated) and not math.isclose(stated, got, rel_tol=1e-4):
            raise DataError(
                f"'{folder / PER_IMAGE}' gives {name} {got:.6g}, but {METRICS} beside it says {stated:.6g}: "
                f"they are not of one test. {again}"
            )
    return result


_NEEDED = (
    "metrics.model", "images", "protocol.name", "protocol.averaging", "protocol.silog.lambda", "protocol.silog.factor",
    "data.source", "data.fingerprint", "split.kind", "split.sha256",
)  # fmt: skip


def _has(document: Any, key: str) -> bool:
    for part in key.split("."):
        if not isinstance(document, dict) or part not in document:
            return False
        document = document[part]
    return True


def stamp_differences(a: Result, b: Result) -> list[str]:
    """Return what keeps two results from being compared, as ``protocol.crop: [45,471,41,601] against none``.

    These are all values of the protocol; source, fingerprint and encoding of the data; kind and sha256 of the split;
    and, for a protocol that scores at network resolution, size and maximum depth, which the truth then follows.
    """
    before, after = _conditions(a), _conditions(b)
    keys = [*before, *(key for key in after if key not in before)]
    return [
        f"{key}: {_spelt(before.get(key))} against {_spelt(after.get(key))}"
        for key in keys
        if before.get(key) != after.get(key)
    ]


def _conditions(result: Result) -> dict[str, Any]:
    conditions = flat(result.stamp, "protocol.")
    if result.stamp.get("resolution") == "network":
        conditions |= {key: result.document.get(key) for key in ("network_size", "max_depth_m")}
    conditions |= {f"data.{key}": result.data.get(key) for key in ("source", "fingerprint", "encoding")}
    return conditions | {f"split.{key}": result.split.get(key) for key in ("kind", "sha256")}


def _spelt(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, str) and len(value) == 64:  # a sha256
        return value[:8]
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def paired(a: Result, b: Result) -> tuple[ImageTable, ImageTable]:
    """Return the images of two results, in the order of the first.

    Splits may differ in what they train on, as long as they test on the same images.

    Raises:
        DataError: if protocol, data or images are not the same; the message says what to do.
    """
    lines = [line for line in stamp_differences(a, b) if not line.startswith("split.")]
    data = [line for line in lines if line.startswith("data.")]
    where = f"'{a.path}' and '{b.path}'"
    if data:
        raise DataError(
            f"{where} were tested on different data ({'; '.join(data)}), so their images cannot be paired. "
            "Test both on one set: hudepth-test checkpoint=<run> data=<name>."
        )
    if lines:
        raise DataError(
            f"{where} were tested under different protocols ({_first(lines)}). "
            "Run hudepth-test on both again with the same settings."
        )
    position = {image: row for row, image in enumerate(b.table.ids)}
    shared = [image for image in a.table.ids if image in position]
    if len(shared) != len(a.table.ids) or len(shared) != len(b.table.ids):
        raise DataError(
            f"{where} were tested on different images: {len(a.table.ids)} of split {a.split['kind']} and "
            f"{len(b.table.ids)} of split {b.split['kind']}, {len(shared)} of them in both. "
            "Compare runs of one data.split, or test both on data neither was trained on: "
            "hudepth-test checkpoint=<run> data=<name>."
        )
    rows = [position[image] for image in a.table.ids]
    other = _take(b.table, rows)
    if other.scenes != a.table.scenes or not np.array_equal(other.pixels, a.table.pixels):
        raise DataError(
            f"{where} name other scenes or numbers of pixels for the same images. Run hudepth-test on both again."
        )
    return a.table, other


def common_images(a: Result, b: Result) -> tuple[ImageTable, ImageTable]:
    """Return the images that both results are of, in the order of the first, as of two splits of one set.

    Raises:
        DataError: if protocol or data differ, or they share no image.
    """
    lines = [line for line in stamp_differences(a, b) if not line.startswith("split.")]
    if lines:
        raise DataError(f"'{a.path}' and '{b.path}' do not compare: {_first(lines)}. Test both with the same settings.")
    position = {image: row for row, image in enumerate(b.table.ids)}
    rows = [row for row, image in enumerate(a.table.ids) if image in position]
    if not rows:
        raise DataError(f"'{a.path}' and '{b.path}' share no test image.")
    return _take(a.table, rows), _take(b.table, [position[a.table.ids[row]] for row in rows])


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
    """Return the rows of one table, one a result: ``name``, then the metrics of its network.

    Args:
        results: by the name of their row.
        metrics: names of the columns. A result that was written before there was such a metric has NaN.
        mark: what to do if protocols, data or splits differ: add the columns ``protocol``, ``data`` and ``split``
            that are needed to tell them apart, instead of an error.

    Raises:
        DataError: if they differ and ``mark`` is not set, or if no result has a metric.
    """
    known = {name for result in results.values() for name in result.metrics}
    for name in metrics:
        if name not in known:
            raise DataError(f"no result has a metric '{name}'.{did_you_mean(name, known)}")
    marks = _marks(results)
    if marks and not mark:
        raise DataError(_apart(results))
    return [
        {
            "name": name,
            **{column: words[name] for column, words in marks.items()},
            **{metric: result.metrics.get(metric, math.nan) for metric in metrics},
        }
        for name, result in results.items()
    ]


def _marks(results: Mapping[str, Result]) -> dict[str, dict[str, str]]:
    """Return, of protocol, data and split, those that differ: by the name of the result, what tells it apart."""
    conditions = {name: _conditions(result) for name, result in results.items()}
    marks = {}
    for column, main in (("protocol", "protocol.name"), ("data", "data.source"), ("split", "split.kind")):
        keys = dict.fromkeys(key for each in conditions.values() for key in each if _part(key) == column)
        pairs = list(combinations(conditions.values(), 2))
        # what differs under one name must be said beside the name
        more = [k for k in keys if any(x[main] == y[main] and x.get(k) != y.get(k) for x, y in pairs)]
        if more or any(x[main] != y[main] for x, y in pairs):
            marks[column] = {
                name: ", ".join([str(x[main]), *(f"{k.partition('.')[2] or k} {_spelt(x[k])}" for k in more if k in x)])
                for name, x in conditions.items()
            }
    return marks


def _part(key: str) -> str:
    part = key.partition(".")[0]
    return part if part in ("data", "split") else "protocol"


def _apart(results: Mapping[str, Result]) -> str:
    (name, first), *others = results.items()
    other, lines = next((n, lines) for n, r in others if (lines := stamp_differences(first, r)))
    return (
        f"the results of '{name}' and '{other}' do not compare: {_first(lines)}. "
        "Run hudepth-test on them again with the same settings, or say in the table what differs."
    )


def _first(lines: Sequence[str]) -> str:
    more = f"; {len(lines) - 3} more" if len(lines) > 3 else ""
    return "; ".join(lines[:3]) + more
