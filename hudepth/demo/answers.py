"""Turn an uploaded file into what the page shows: check it before decoding, predict, and pack the result."""

from __future__ import annotations

import base64
import re
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from hudepth.base.errors import ConfigError, DataError
from hudepth.base.images import read_photo, resize_image
from hudepth.data.store import to_mm
from hudepth.inference.depth_map import DepthMap, jpeg
from hudepth.inference.model import DepthModel
from hudepth.viz.colour import auto_scale, colour_depth
from hudepth.viz.point_cloud import depth_edges

MAX_SIDE = 640  # of the map that goes to the browser [pixels]: more than the networks resolve, and less than a megabyte


class Limits(NamedTuple):
    """The largest picture that is accepted, and what all visitors' files may hold."""

    upload_bytes: int
    pixels: int
    kept_bytes: int = 200 << 20


@dataclass(frozen=True)
class Answer:
    """The depth of a picture, at its own size and as shown."""

    name: str  # of the picture's file, without its ending
    depth: DepthMap
    shown: DepthMap  # the same, with sides of at most MAX_SIDE; its pixels are picked from depth, not averaged
    payload: dict[str, Any]  # input of the page's script


def answer(path: Path, model: DepthModel, limits: Limits, camera: str | None = None) -> Answer:
    """Predict the depth of an uploaded picture; raises DataError with one line for the visitor.

    ``camera`` is the visitor's choice, as :func:`hudepth.load` takes it; None is the model's. Where that cannot have
    taken the picture, the camera of the training images stands in, and the facts say so.
    """
    start = time.perf_counter()
    data = _read_upload(path, limits.upload_bytes)
    photo = read_photo(data, where=f"'{path.name}'", max_pixels=limits.pixels)
    try:
        depth = model.predict(photo, camera=camera)
    except ConfigError:
        note = "the camera that was set cannot have taken a picture of this size"
        depth = model.predict(photo._replace(notes=(*photo.notes, note)), camera="training")
    shown = reduce_depth(depth)
    rows, columns = shown.metres.shape
    assert shown.camera is not None
    payload = {
        "width": columns,
        "height": rows,
        "depth_mm": base64.b64encode(to_mm(shown.metres).astype("<u2").tobytes()).decode(),
        "edges": base64.b64encode(np.packbits(depth_edges(shown.metres, shown.camera)).tobytes()).decode(),
        "photo": f"data:image/jpeg;base64,{base64.b64encode(jpeg(shown.image, quality=88)).decode()}",
        "max_depth_m": depth.max_depth_m / depth.camera_factor,  # of all pictures, whatever the camera
        "scale_m": list(auto_scale(depth.metres)),
        "camera": list(shown.camera.numbers),
        "facts": _facts(path.name, depth, seconds=time.perf_counter() - start),
    }
    return Answer(path.stem[:80], depth, shown, payload)


def _read_upload(path: Path, max_bytes: int) -> bytes:
    where = f"'{path.name}'"
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise DataError(f"{where}: {size / 2**20:.1f} MB, the limit is {max_bytes / 2**20:g}. Resize the picture.")
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{where}: cannot be read ({error.strerror}). Choose the picture again.") from None


def reduce_depth(depth: DepthMap, max_side: int = MAX_SIDE) -> DepthMap:
    """Return a depth map with sides of at most ``max_side`` pixels: depth is picked, colours are averaged."""
    shape = depth.metres.shape
    shrink = max(shape) / max_side
    if shrink <= 1:
        return depth
    rows, columns = (max(1, round(length / shrink)) for length in shape)
    pairs = zip((rows, columns), shape, strict=True)
    centres = [((np.arange(n) + 0.5) * (length / n)).astype(np.intp) for n, length in pairs]
    image = resize_image(depth.image, (rows, columns))
    camera = depth.camera and depth.camera.scale(columns / shape[1], rows / shape[0])
    return replace(depth, metres=depth.metres[np.ix_(*centres)], image=image, camera=camera, uncertainty_m=None)


def colour_table() -> UInt8[np.ndarray, "256 3"]:
    """Return the colours of the depth scale, near first."""
    steps = np.arange(256, dtype=np.float32)[None]
    steps[0, 0] = 1e-3  # 0 means unmeasured
    return np.asarray(colour_depth(steps, scale_m=(0.0, 255.0), legend=False)[0])


def _facts(name: str, depth: DepthMap, *, seconds: float) -> list[str]:
    """Return what there is to say of a picture, a line each."""
    height, width = depth.metres.shape
    near, middle, far = (float(np.quantile(depth.metres[::4, ::4], q)) for q in (0.01, 0.5, 0.99))
    return [
        f"{name}, {width} x {height}",
        f"{near:.2f} to {far:.2f} m away, median {middle:.2f} m",
        _camera_words(depth),
        *(note[:1].upper() + note[1:] for note in depth.notes),
        f"Estimated in {seconds:.2f} s",
    ]


def _camera_words(depth: DepthMap) -> str:
    """Return whose camera the metres are for, in words of people who have not read the options."""
    words = depth.whose_camera
    if depth.camera is not None and not depth.camera.known:
        words = words.replace("'s, assumed", "'s camera assumed").replace("camera, assumed", "camera assumed")
        return f"{words[0].upper()}{words[1:]}: set the field of view"
    for key, unit in (("fov", " degrees across"), ("f35", " mm on 35 mm film"), ("f", " pixels of focal length")):
        words = re.sub(rf"\b{key}=([\d.e+]+)", rf"\1{unit}", words)
    return f"Camera {words}"
