"""Images on which exports are compared with their checkpoint, and with which int8 is calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from hudepth.base.console import log
from hudepth.base.errors import DataError, HudepthError
from hudepth.base.images import read_photo, resize_image
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.evaluation.test_data import open_data
from hudepth.inference.inputs import find_inputs
from hudepth.runs.checkpoint import Checkpoint


@dataclass(frozen=True)
class ComparisonImages:
    """Images at the model's size, and their origin."""

    compared: UInt8[np.ndarray, "n h w 3"]
    calibration: UInt8[np.ndarray, "m h w 3"]
    origin: str
    datamodule: DepthDataModule | None = None


def find_images(
    checkpoint: Checkpoint,
    *,
    folder: str | None,
    size: tuple[int, int],
    compared: int,
    calibration: int,
    data: Mapping[str, Any],
    trust: list[str],
) -> ComparisonImages:
    """Return at least one image each to compare and to calibrate with: of a folder, the checkpoint's data, or rooms.

    Of the checkpoint's data, as changed by ``data``, test images are compared and training images calibrate, so that
    accuracy is measured on images that calibration did not see. Raises HudepthError if the folder has no readable
    image, or data that ``data`` points to cannot be opened.
    """
    most = max(compared, calibration)
    if folder is not None:
        if not (items := find_inputs(folder, recursive=True).images):
            raise DataError(f"images: no image in '{folder}'.")
        chosen = [items[i].path for i in _spread(len(items), most)]
        images = np.stack([resize_image(read_photo(path).rgb, size) for path in chosen])
        return ComparisonImages(images[:compared], images[:calibration], f"images of '{Path(folder).name}'")
    datamodule = _open_data(checkpoint, data, trust)
    if datamodule is None:
        source = RoomsSource(scenes=-(-most // 4), frames_per_scene=4)
        images = np.stack([resize_image(source.read(record).image, size) for record in source.records()[:most]])
        return ComparisonImages(images[:compared], images[:calibration], "synthetic rooms")
    test = _read(datamodule, datamodule.split["test"], compared, size)
    train = _read(datamodule, datamodule.split["train"], calibration, size)
    return ComparisonImages(test, train, f"test images of {datamodule.source.name}", datamodule)


def _open_data(checkpoint: Checkpoint, data: Mapping[str, Any], trust: list[str]) -> DepthDataModule | None:
    try:
        datamodule, _ = open_data(checkpoint, data, trust=trust)
        _ = datamodule.store
    except HudepthError as error:
        if data.keys() - {"cache"}:  # a data set that the user names must be there
            raise
        source = checkpoint.data.get("source")
        log.warning("%s is not here (%s); synthetic rooms replace it. Pass data.root=<folder>.", source, error)
        return None
    return datamodule


def _read(datamodule: DepthDataModule, indices: Any, count: int, size: tuple[int, int]) -> UInt8[np.ndarray, "n h w 3"]:
    images, _ = datamodule.store.read(sorted(int(indices[i]) for i in _spread(len(indices), count)))
    return np.stack([resize_image(image, size) if image.shape[:2] != size else image for image in images])


def _spread(length: int, count: int) -> list[int]:
    """Return up to ``count`` indices, evenly spaced."""
    return [int(i) for i in np.linspace(0, length - 1, min(count, length)).round()] if length else []
