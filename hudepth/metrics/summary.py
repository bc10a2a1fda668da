"""Metrics of a set of images from those of each image.

Over images: the mean of the images' metrics. Pooled over all pixels, of which n_i of image i count:

    mean metrics (abs_rel, sq_rel, mse, log10, mae, delta_k)   sum n_i x_i / sum n_i
    rmse, rmse_log                                             sqrt(sum n_i x_i^2 / sum n_i)
    silog   factor * sqrt(rmse_log^2 - lambda * log_bias^2), both pooled; log_bias is the mean of ln p - ln t

Of any set, whatever the averaging: ``rmse_pooled``, the pooled rmse, and ``scale_sd``, the standard deviation of the
images' log_scale (:mod:`hudepth.metrics.scale`).

So a metric of any set follows from columns that add up over images (:func:`additive`), which resampling uses too. The
metrics themselves are defined in :mod:`hudepth.metrics.depth`, with which pooling agrees.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NotRequired, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.base.files import read_text
from hudepth.metrics.catalogue import depth_names, metric_info

Floats = NDArray[np.float64]

LOG_BIAS = "log_bias"
"""Mean of ln p - ln t: not a metric, but pooled silog follows from it."""
LOG_SCALE = "log_scale"
"""Of an image, see :mod:`hudepth.metrics.scale`: not a metric, but ``scale_sd`` follows from it."""
DEPTH_NAMES = (*depth_names(), LOG_BIAS)
"""Defined for every image with a valid pixel; others, like ssim, may be undefined (NaN) for some images."""
KEYS = ("id", "scene", "category", "pixels")
"""First columns of per_image.csv."""


@dataclass(frozen=True)
class ImageTable:
    """Metrics of each image of a set, one row per image; NaN where undefined."""

    ids: list[str]
    scenes: list[str]
    """Empty if the data set has none."""
    categories: list[str]
    pixels: NDArray[np.int64]
    """[n] pixels that count."""
    values: dict[str, Floats]
    """[n] by metric."""


class SummaryOptions(TypedDict):
    """How the metrics of images become those of a set."""

    averaging: str
    """``image`` or ``pooled``. Metrics that are undefined for some images, like ssim, are always averaged over the
    images where they are defined."""
    silog_lambda: NotRequired[float]
    """Of pooled silog, as in :func:`hudepth.metrics.depth.depth_metrics_from_sums`; default: 1."""
    silog_factor: NotRequired[float]
    """The same; default: 100."""


def summarise(table: ImageTable, **options: Unpack[SummaryOptions]) -> dict[str, float]:
    """Return the metrics of all images of a table together, without ``log_bias`` and ``log_scale``.

    Pooled silog only if the table has ``log_bias``. Images without a pixel that counts are skipped. NaN where a
    prediction was NaN (skipping it would flatter), and where a metric is defined for no image.
    """
    columns = additive(table, averaging=options["averaging"])
    metrics = metrics_from_sums({name: x.sum(axis=1, keepdims=True) for name, x in columns.items()}, **options)
    return {name: value.item() for name, value in metrics.items()}


def additive(table: ImageTable, *, averaging: str) -> dict[str, Floats]:
    """Return columns that add up over images: for each name [2, n], weighted values and their weights."""
    columns = {}
    for name, values in table.values.items():
        pooled = averaging == "pooled" and name in DEPTH_NAMES
        weights = (table.pixels if pooled else table.pixels > 0).astype(np.float64)
        if name not in DEPTH_NAMES:
            weights[np.isnan(values)] = 0
        terms = weights * (values**2 if pooled and metric_info(name).pool == "squares" else values)
        columns[name] = np.stack([np.where(weights > 0, terms, 0), weights])
    if "rmse" in table.values:
        terms = np.where(table.pixels > 0, table.pixels * table.values["rmse"] ** 2, 0)
        columns["rmse_pooled"] = np.stack([terms, table.pixels.astype(np.float64)])
    if LOG_SCALE in columns:
        terms, weights = columns[LOG_SCALE]
        columns["scale_sd"] = np.stack([terms**2, weights])
    return columns


def metrics_from_sums(
    sums: Mapping[str, Floats], *, averaging: str, silog_lambda: float = 1.0, silog_factor: float = 100.0
) -> dict[str, Floats]:
    """Turn sums of :func:`additive` columns, [2, *] by name, into metrics, [*] by name; NaN where a weight is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        means = {name: terms / weights for name, (terms, weights) in sums.items()}
        bias, log_scale = means.pop(LOG_BIAS, None), means.pop(LOG_SCALE, None)
        if log_scale is not None:
            means["scale_sd"] = np.sqrt(np.maximum(means["scale_sd"] - log_scale**2, 0))
        if "rmse_pooled" in means:
            means["rmse_pooled"] = np.sqrt(means["rmse_pooled"])
        if averaging == "pooled":
            if means.pop("silog", None) is not None and bias is not None and "rmse_log" in means:
                variance = means["rmse_log"] - silog_lambda * bias**2
                means["silog"] = silog_factor * np.sqrt(np.maximum(variance, 0))  # rounding can leave less than 0
            means |= {name: np.sqrt(mean) for name, mean in means.items() if metric_info(name).pool == "squares"}
    return means


def per_image_csv(table: ImageTable) -> str:
    """Return per_image.csv: id, scene, category, pixels, then the metrics with 9 significant digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*KEYS, *table.values])
    keys = zip(table.ids, table.scenes, table.categories, table.pixels.tolist(), strict=True)
    for row, (image, scene, category, pixels) in enumerate(keys):
        numbers = (f"{values[row]:.9g}" for values in table.values.values())
        writer.writerow([image, scene, category, pixels, *numbers])
    return text.getvalue()


def read_per_image(path: Path) -> ImageTable:
    """Read the output of :func:`per_image_csv`; raises DataError, with file and line, if it is missing or damaged."""
    again = "Run hudepth-test again."
    rows: dict[str, list[str]] = {}
    numbers: list[list[float]] = []
    try:
        with io.StringIO(read_text(path), newline="") as file:
            reader = csv.reader(file)
            names = next(reader, [])
            if tuple(names[: len(KEYS)]) != KEYS or len(set(names)) != len(names) or len(names) == len(KEYS):
                raise DataError(f"'{path}', line 1: the header is not {', '.join(KEYS)} and then metrics. {again}")
            for cells in reader:
                where = f"'{path}', line {reader.line_num}"
                if len(cells) != len(names):
                    raise DataError(f"{where}: {len(cells)} values under {len(names)} names. {again}")
                if cells[0] in rows:
                    raise DataError(f"{where}: a second row of image '{cells[0]}'. {again}")
                numbers.append(_numbers(cells, names, where=where, fix=again))
                rows[cells[0]] = cells[: len(KEYS)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"'{path}' cannot be read as a table of images ({error}). {again}") from error
    if not rows:
        raise DataError(f"'{path}' contains no image. {again}")
    ids, scenes, categories, pixels = (list(column) for column in zip(*rows.values(), strict=True))
    counts = np.array([int(count) for count in pixels], dtype=np.int64)
    values = dict(zip(names[len(KEYS) :], np.ascontiguousarray(np.array(numbers).T), strict=True))
    return ImageTable(ids, scenes, categories, counts, values)


def _numbers(cells: list[str], names: list[str], *, where: str, fix: str) -> list[float]:
    """Convert a row."""
    if not cells[3].isascii() or not cells[3].isdigit() or len(cells[3]) > 18:  # what 64 bits hold
        raise DataError(f"{where}: pixels '{cells[3]}' is not a count. {fix}")
    numbers: list[float] = []
    try:
        numbers.extend(map(float, cells[len(KEYS) :]))  # at once: a report may read hundreds of thousands of rows
    except ValueError:
        at = len(KEYS) + len(numbers)
        raise DataError(f"{where}: {names[at]} '{cells[at]}' is not a number. {fix}") from None
    return numbers
