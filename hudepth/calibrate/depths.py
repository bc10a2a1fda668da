"""The measured depths that a calibration is fitted on: of a data set's pairs, or of points in pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hudepth.base.camera import CameraChoice
from hudepth.base.console import log, track
from hudepth.base.errors import DataError
from hudepth.base.images import read_bytes
from hudepth.calibrate.fitting import Measured
from hudepth.data.pairs import read_metres
from hudepth.data.sources.base import Source
from hudepth.data.sources.files import csv_rows, inside
from hudepth.inference.model import DepthModel

MOST_PIXELS = 5000
"""Of an image: evenly spaced ones do, and a set of thousands fits into memory."""
COLUMNS = ("image", "x", "y", "metres")
Size = tuple[int, int]


def of_pairs(source: Source, model: DepthModel, *, most: int) -> tuple[list[Measured], list[Size]]:
    """Predict at most so many pairs of a data set, evenly spaced, at the size of their ground truth.

    Returns depths, and (height, width) of the images. Raises DataError if a pair cannot be read.
    """
    records = source.records()
    chosen = [records[round(i)] for i in np.linspace(0, len(records) - 1, min(most, len(records)))]
    found, sizes, shares = [], [], []
    for record in track(chosen, total=len(chosen), what="predicting"):
        pair = source.read(record)
        truth = read_metres(source, record, pair.depth)
        pred = model.predict(pair.image, camera="training").metres
        if pred.shape != truth.shape:
            pred = np.asarray(cv2.resize(pred, (truth.shape[1], truth.shape[0])), np.float32)
        shares.append(float((truth > model.info.max_depth_m).sum() / max(1, (truth > 0).sum())))
        measured = _measured(record.id, record.scene, pred, truth, limit_m=model.info.max_depth_m)
        if measured is not None:
            found.append(measured)
            sizes.append((pair.image.shape[0], pair.image.shape[1]))
    if (beyond := float(np.mean(shares))) > 0.01:
        limit = f"{model.info.max_depth_m:g} m, the model's largest depth"
        log.warning("%.0f %% of the measured depth is beyond %s: left out", 100 * beyond, limit)
    return found, sizes


def _measured(
    name: str, scene: str, pred_m: NDArray[np.float32], truth_m: NDArray[np.float32], *, limit_m: float
) -> Measured | None:
    """Return what is measured within the range that the model knows; None if nothing is."""
    counts = np.flatnonzero((truth_m > 1e-3) & (truth_m <= limit_m) & (pred_m > 1e-3))
    if not counts.size:
        return None
    kept = counts[:: max(1, math.ceil(counts.size / MOST_PIXELS))]
    pred, truth = (depth.ravel()[kept].astype(np.float64) for depth in (pred_m, truth_m))
    return Measured(name, scene, pred, truth)


def of_points(path: Path, model: DepthModel) -> tuple[list[Measured], list[Size]]:
    """Predict the pictures of a CSV file with the columns image, x, y [pixels of the upright picture] and metres.

    ``x`` and ``y`` count from the centre of the upper left pixel; metres are along the optical axis; pictures lie in
    the file's folder. Returns as :func:`of_pairs`. Raises DataError for what cannot be read or lies outside.
    """
    found, sizes = [], []
    for name, points in _read_points(path).items():
        depth = model.predict(inside(path.parent, name, where=f"'{path}'"), camera="training").metres
        height, width = depth.shape
        for line, x, y, _ in points:
            if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
                raise DataError(
                    f"'{path}' line {line}: ({x:g}, {y:g}) is outside the picture, {width} x {height}. "
                    "Write x, then y, in pixels of the upright picture."
                )
        pred = [max(float(depth[round(y), round(x)]), 1e-3) for _, x, y, _ in points]
        found.append(Measured(name, "", np.array(pred), np.array([metres for *_, metres in points])))
        sizes.append((height, width))
    return found, sizes


def _read_points(path: Path) -> Mapping[str, list[tuple[int, float, float, float]]]:
    """Return line, x, y and metres of the points of each picture."""
    rows = csv_rows(read_bytes(path), where=f"'{path}'")
    header = [cell.strip() for cell in rows[0][1]] if rows else []
    if missing := [column for column in COLUMNS if column not in header]:
        raise DataError(f"'{path}': no column {' and '.join(missing)}. Name {','.join(COLUMNS)} in its first line.")
    points: dict[str, list[tuple[int, float, float, float]]] = {}
    for line, cells in rows[1:]:
        row = dict(zip(header, (cell.strip() for cell in cells), strict=False))
        try:
            x, y, metres = (float(row[column]) for column in COLUMNS[1:])
            if not (math.isfinite(x) and math.isfinite(y) and 0 < metres < math.inf and row["image"]):
                raise ValueError
        except (ValueError, KeyError):
            raise DataError(
                f"'{path}' line {line}: is not image,x,y,metres, with metres above 0. Correct it."
            ) from None
        points.setdefault(row["image"], []).append((line, x, y, metres))
    if not points:
        raise DataError(f"'{path}': lists no points. Add a line for each.")
    return points


def focal_of(camera: str | tuple[float, ...] | None, sizes: list[Size]) -> tuple[float, float] | None:
    """Return the focal lengths over the sides of the pictures; None if no camera is stated."""
    return None if camera is None else CameraChoice.of(camera).over_sides(sorted(set(sizes)), key="camera")
