"""From an uploaded file to what the page shows: checked before it is decoded, computed, and packed small."""

from __future__ import annotations

import base64
import io
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray
from PIL import Image

from hudepth.base.camera import Intrinsics
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.images import FORMATS, MAX_PIXELS, read_photo, resize_image
from hudepth.data.store import to_mm
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.model import DepthModel
from hudepth.viz.colour import colour_depth

MAX_SIDE = 640
"""Of the map that goes to the browser [pixels]: more than any network here tells apart, and less than a megabyte."""
JPEG_QUALITY = 88


@dataclass(frozen=True)
class Limits:
    """What is taken from whoever opens the page."""

    upload_bytes: int
    pixels: int

    def __post_init__(self) -> None:
        if not 0 < self.pixels <= MAX_PIXELS:
            raise ConfigError(f"max_pixels: {self.pixels} is not from 1 to {MAX_PIXELS}. Leave it out for 40000000.")


@dataclass(frozen=True)
class Answer:
    """A picture's depth, at its own size and as it is shown."""

    name: str
    """The picture's file name, without ending."""
    depth: DepthMap
    shown: DepthMap
    """The same, with sides of at most :data:`MAX_SIDE`: each pixel is one of ``depth``, none is a mean of several."""
    camera: Intrinsics
    """In pixels of ``shown``."""
    payload: dict[str, Any]
    """What the page's script is given."""


def answer(path: Path, model: DepthModel, limits: Limits, intrinsics: Intrinsics | None = None) -> Answer:
    """Predict the depth of an uploaded picture.

    Args:
        path: the file.
        model: what predicts.
        limits: what is refused.
        intrinsics: of the camera, in pixels of the picture; None: NYU's, scaled.

    Raises:
        DataError: with one line for whoever uploaded it.
    """
    start = time.perf_counter()
    photo = read_photo(read_upload(path, limits), where=f"'{path.name}'")
    depth = replace(model.predict(photo.rgb), notes=photo.notes)
    shown = reduced(depth)
    (height, width), (rows, columns) = depth.metres.shape, shown.metres.shape
    camera = scaled(intrinsics or Intrinsics.of_nyu(height, width), columns / width, rows / height)
    payload = {
        "width": columns,
        "height": rows,
        "depth_mm": base64.b64encode(to_mm(shown.metres).astype("<u2").tobytes()).decode(),
        "photo": _data_url(shown.image),
        "max_depth_m": depth.max_depth_m,
        "camera": [camera.fx, camera.fy, camera.cx, camera.cy],
        "caption": _caption(path.name, depth, seconds=time.perf_counter() - start),
    }
    return Answer(path.stem[:80], depth, shown, camera, payload)


def read_upload(path: Path, limits: Limits) -> bytes:
    """Return an uploaded file, unless it is larger than is taken; nothing is decoded but its header.

    Raises:
        DataError: if it is missing, or has too many bytes or pixels.
    """
    where = f"'{path.name}'"
    try:
        size = path.stat().st_size
        if size > limits.upload_bytes:
            most = f"{limits.upload_bytes / 2**20:g}"
            raise DataError(f"{where}: {size / 2**20:.1f} MB, at most {most} are taken. Resize the picture.")
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{where}: cannot be read ({error.strerror}). Choose the picture again.") from None
    width, height = _stated_size(data)
    if width * height > limits.pixels:
        most = f"{limits.pixels / 1e6:g} million"
        raise DataError(f"{where}: {width} x {height} pixels, at most {most} are taken. Resize the picture.")
    return data


def _stated_size(data: bytes) -> tuple[int, int]:
    """Return (width, height) as the header says, or zeros where there is none: what decodes it finds the words."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                return image.size
    except Exception:
        return 0, 0


def reduced(depth: DepthMap, max_side: int = MAX_SIDE) -> DepthMap:
    """Return a depth map with sides of at most ``max_side`` pixels: depth picked, colours averaged."""
    height, width = depth.metres.shape
    shrink = max(height, width) / max_side
    if shrink <= 1:
        return depth
    rows, columns = max(1, round(height / shrink)), max(1, round(width / shrink))
    picked = depth.metres[np.ix_(_centres(height, rows), _centres(width, columns))]
    return DepthMap(picked, resize_image(depth.image, (rows, columns)), depth.max_depth_m, depth.notes)


def _centres(length: int, count: int) -> NDArray[np.intp]:
    return ((np.arange(count) + 0.5) * (length / count)).astype(np.intp)


def scaled(camera: Intrinsics, x: float, y: float) -> Intrinsics:
    """Return a camera's intrinsics for the same picture at ``x`` times the width and ``y`` times the height."""
    return Intrinsics(
        camera.fx * x, camera.fy * y, (camera.cx + 0.5) * x - 0.5, (camera.cy + 0.5) * y - 0.5, known=camera.known
    )


def colour_table() -> UInt8[np.ndarray, "256 3"]:
    """Return the colours of the depth scale, near first."""
    steps = np.arange(256, dtype=np.float32)[None]
    steps[0, 0] = 1e-3  # 0 would be unmeasured
    return np.asarray(colour_depth(steps, scale_m=(0.0, 255.0), legend=False)[0])


def _data_url(rgb: UInt8[np.ndarray, "h w 3"]) -> str:
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def _caption(name: str, depth: DepthMap, *, seconds: float) -> str:
    height, width = depth.metres.shape
    near, middle, far = (float(np.quantile(depth.metres[::4, ::4], q)) for q in (0.01, 0.5, 0.99))
    parts = [
        f"{name}, {width} x {height}",
        f"{near:.2f} to {far:.2f} m, median {middle:.2f} m",
        f"{seconds:.2f} s",
        *depth.notes,
    ]
    return "; ".join(parts)
