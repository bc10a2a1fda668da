"""The files a prediction is kept in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from jaxtyping import UInt8

from hudepth.base.camera import Intrinsics
from hudepth.base.files import written_whole
from hudepth.inference.depth_map import DepthMap

JPEG_QUALITY = 92


@dataclass(frozen=True)
class Style:
    """What all pictures and clouds of a run have in common."""

    scale_m: tuple[float, float]
    """Ends of the colour scale [m]."""
    intrinsics: Intrinsics | None = None
    """Of the camera, in pixels of the images; None: NYU's, scaled to each."""


def _npy(depth: DepthMap, file: IO[bytes], _style: Style) -> None:
    np.save(file, depth.metres)


def _png16(depth: DepthMap, file: IO[bytes], _style: Style) -> None:
    file.write(depth.to_png16())


def _colour(depth: DepthMap, file: IO[bytes], style: Style) -> None:
    file.write(jpeg(depth.colourise(scale_m=style.scale_m)))


def _side(depth: DepthMap, file: IO[bytes], style: Style) -> None:
    file.write(jpeg(depth.side_by_side(scale_m=style.scale_m)))


def _ply(depth: DepthMap, file: IO[bytes], style: Style) -> None:
    file.write(depth.point_cloud(style.intrinsics).to_ply())


FORMATS: dict[str, tuple[str, Callable[[DepthMap, IO[bytes], Style], None]]] = {
    "png16": ("_depth.png", _png16),
    "npy": ("_depth.npy", _npy),
    "colour": ("_depth.jpg", _colour),
    "side": ("_side.jpg", _side),
    "ply": ("_depth.ply", _ply),
}
"""By name: how the file's name goes on after the image's, and what writes it. ``png16`` is in millimetres, ``npy`` and
``ply`` in metres, ``colour`` and ``side`` are pictures with a scale."""


def write_depth(stem: Path, depth: DepthMap, formats: Sequence[str], style: Style) -> None:
    """Write ``<stem>_depth.png`` and so on, each whole or not at all.

    Args:
        stem: path without an ending.
        depth: what to write.
        formats: names in :data:`FORMATS`.
        style: of pictures and clouds.

    Raises:
        OSError: whatever the file system says.
    """
    for name in formats:
        ending, write = FORMATS[name]
        with written_whole(stem.with_name(stem.name + ending), durable=False) as part, part.open("wb") as file:
            write(depth, file, style)


def jpeg(rgb: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Return a picture as a JPEG file."""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
