"""Results of hudepth-test: finding and reading metrics.json and per_image.csv."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hudepth.base.errors import DataError, did_you_mean
from hudepth.base.files import read_json
from hudepth.metrics.summary import ImageTable, read_per_image, summarise

METRICS, PER_IMAGE = "metrics.json", "per_image.csv"
MODEL = "model"
"""Name of the network among the predictors in metrics.json."""
CHECKED = ("abs_rel", "rmse")
"""Metrics that must agree between per_image.csv and metrics.json."""
LARGEST = 1e12
"""No metric of a depth network is larger; sums of such numbers stay finite."""
_AGAIN = "Run hudepth-test again."
_NEEDED = (
    "images", "protocol.name", "protocol.averaging", "protocol.silog.lambda", "protocol.silog.factor",
    "data.source", "data.fingerprint", "split.kind", "split.sha256",
)  # fmt: skip


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
        """Source, fingerprint, encoding and more of the data."""
        return dict(self.document["data"])

    @property
    def split(self) -> dict[str, Any]:
        """Kind, seed, fractions, counts and sha256 of the split."""
        return dict(self.document["split"])

    @property
    def metrics(self) -> dict[str, float]:
        """The network's metrics; NaN where the file has null."""
        return {k: math.nan if v is None else float(v) for k, v in self.document["metrics"][MODEL].items()}

    @property
    def averaging(self) -> dict[str, Any]:
        """The protocol's options for :func:`hudepth.metrics.summary.summarise` and the bootstrap."""
        weight, factor = (float(self.stamp["silog"][key]) for key in ("lambda", "factor"))
        return {"averaging": self.stamp["averaging"], "silog_lambda": weight, "silog_factor": factor}


def find_result(run_or_folder: str | Path, protocol: str) -> Result:
    """Read a test result. Raises DataError if there is none, or if its files are damaged or do not belong together.

    The folder is a run directory, that of a study, their folder ``test`` (or another ``output=`` of hudepth-test), or
    the folder of the protocol itself.
    """
    folder = Path(run_or_folder).expanduser()
    if not folder.is_dir():
        raise DataError(f"no folder '{folder}'. Pass a run directory or a folder of test results.")
    places = [folder / "test" / protocol, folder / protocol, folder]
    found = next((place for place in places if (place / METRICS).is_file()), None)
    if found is None:
        others = {file.parent.name for pattern in ("test/*", "*") for file in folder.glob(f"{pattern}/{METRICS}")}
        there = f" It holds {', '.join(sorted(others))}.{did_you_mean(protocol, others)}" if others else ""
        fix = f"Run hudepth-test checkpoint={folder} protocol={protocol}."
        raise DataError(f"'{folder}' holds no test result of protocol '{protocol}'.{there} {fix}")
    result = _read(found)
    if (name := result.protocol_name) != protocol:
        raise DataError(f"'{found}' is a test result of protocol '{name}', not of '{protocol}'. Pass protocol={name}.")
    return result


def read_metrics(file: Path) -> dict[str, Any]:
    """Read a metrics.json, which has at least metrics of the network. Raises DataError if it is missing or damaged."""
    try:
        document = read_json(file)
    except (OSError, ValueError) as error:
        raise DataError(f"'{file}' cannot be read ({error}). {_AGAIN}") from error
    if not isinstance(_at(document, f"metrics.{MODEL}"), dict):
        raise DataError(f"'{file}' is not a test result: it has no metrics.{MODEL}. {_AGAIN}")
    for key in ("data", "split", "protocol", "intervals", "checkpoint"):
        if not isinstance(document.get(key, {}), dict):
            raise DataError(f"'{file}' is not a test result: its {key} is not a mapping. {_AGAIN}")
    return dict(document)


def _read(folder: Path) -> Result:
    path, per_image = folder / METRICS, folder / PER_IMAGE
    document = read_metrics(path)
    if missing := next((key for key in _NEEDED if _at(document, key) is None), None):
        raise DataError(f"'{path}' is not a test result: it has no {missing}. {_AGAIN}")
    if not per_image.is_file():
        raise DataError(f"'{folder}' has a {METRICS} but no {PER_IMAGE}. {_AGAIN}")
    result = Result(path=folder, document=document, table=read_per_image(per_image))
    try:
        metrics, averaging = result.metrics, result.averaging
    except (AttributeError, TypeError, ValueError) as error:
        raise DataError(f"'{path}' is not a test result ({error}). {_AGAIN}") from error
    finite = ((name, np.nan_to_num(each, posinf=0, neginf=0)) for name, each in result.table.values.items())
    numbers: list[tuple[str, Any]] = [*metrics.items(), *finite]
    if large := next((name for name, value in numbers if np.any(np.abs(value) > LARGEST)), None):
        raise DataError(f"'{path}' is not a test result: its {large} is beyond {LARGEST:g}. {_AGAIN}")
    count = len(result.table.ids)
    if count != document["images"]:
        raise DataError(f"'{per_image}' has {count} images, but {METRICS} states {document['images']}. {_AGAIN}")
    means = summarise(result.table, **averaging)
    for name in CHECKED:
        stated, got = metrics.get(name, math.nan), means.get(name, math.nan)
        if math.isfinite(stated) and not math.isclose(stated, got, rel_tol=1e-4):
            why = f"gives {name} {got:.6g}, but {METRICS} states {stated:.6g}: they are not from the same test"
            raise DataError(f"'{per_image}' {why}. {_AGAIN}")
    return result


def _at(document: Any, key: str) -> Any:
    """Look up a dotted key, None if there is none."""
    for part in key.split("."):
        document = document.get(part) if isinstance(document, dict) else None
    return document
