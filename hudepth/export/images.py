"""Images that exports are compared on and calibrated with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from hudepth.base.console import log
from hudepth.base.errors import ConfigError, DataError, HudepthError
from hudepth.base.images import read_photo, resize_image
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.evaluation.test_data import open_data
from hudepth.inference.inputs import find_inputs
from hudepth.runs.checkpoint import Checkpoint


@dataclass(frozen=True)
class ExportImages:
    """Images at the model's size, and where they are from."""

    compared: UInt8[np.ndarray, "n h w 3"]
    calibration: UInt8[np.ndarray, "m h w 3"]
    origin: str
    datamodule: DepthDataModule | None
    """The checkpoint's data, if it is here."""


def export_images(checkpoint: Checkpoint, config: dict[str, Any], *, size: tuple[int, int]) -> ExportImages:
    """Return images from a folder, else from the checkpoint's data, else of rooms.

    Of the checkpoint's data, test images are compared on and training images calibrate: the accuracy that is measured
    on test images afterwards is that of images never seen.

    Args:
        checkpoint: says what it was trained on.
        config: of hudepth-export.
        size: (height, width) of the model's input.

    Raises:
        HudepthError: if the folder holds no image that can be read.
    """
    compared, calibration = int(config["compared"]), int(config["calibration"])
    if config["images"] is not None:
        return _from_folder(str(config["images"]), size, compared, calibration)
    datamodule = _own_data(checkpoint, config)
    if datamodule is None:
        rooms = _rooms(size, max(compared, calibration))
        return ExportImages(rooms[:compared], rooms[:calibration], "built-in rooms", None)
    test, train = (datamodule.split[subset] for subset in ("test", "train"))
    first = _from_store(datamodule, test, compared, size)
    second = _from_store(datamodule, train, calibration, size)
    return ExportImages(first, second, f"test images of {datamodule.source.name}", datamodule)


def _own_data(checkpoint: Checkpoint, config: dict[str, Any]) -> DepthDataModule | None:
    typed = {"cache": config["paths"]["cache"], **config["data"]}
    try:
        datamodule, _ = open_data(checkpoint, typed, overrides=[], trust=config["trust"])
        _ = datamodule.store
    except HudepthError as error:
        if config["data"]:  # it was typed, so it is wanted
            raise
        source = checkpoint.data.get("source")
        log.warning("%s is not here (%s); images of built-in rooms stand in. Pass data.root=<folder>.", source, error)
        return None
    return datamodule


def _from_folder(folder: str, size: tuple[int, int], compared: int, calibration: int) -> ExportImages:
    items = find_inputs(folder, recursive=True).images
    if not items:
        raise DataError(f"images: no image in '{folder}'.")
    chosen = [items[i] for i in _evenly(len(items), max(compared, calibration))]
    images = np.stack([resize_image(read_photo(item.path).rgb, size) for item in chosen])
    return ExportImages(images[:compared], images[:calibration], f"images of '{Path(folder).name}'", None)


def _from_store(
    datamodule: DepthDataModule, indices: Any, count: int, size: tuple[int, int]
) -> UInt8[np.ndarray, "n h w 3"]:
    chosen = sorted(int(indices[i]) for i in _evenly(len(indices), count))
    images, _ = datamodule.store.read(chosen)
    return np.stack([resize_image(image, size) if image.shape[:2] != size else image for image in images])


def _rooms(size: tuple[int, int], count: int) -> UInt8[np.ndarray, "n h w 3"]:
    source = RoomsSource(scenes=-(-count // 4), frames_per_scene=4)
    return np.stack([resize_image(source.read(record).image, size) for record in source.records()[:count]])


def _evenly(length: int, count: int) -> list[int]:
    if count < 1:
        raise ConfigError(f"compared, calibration: {count} images are too few. Pass at least 1.")
    return [int(i) for i in np.linspace(0, length - 1, min(count, length)).round()] if length else []
