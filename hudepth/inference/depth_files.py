"""The file formats of a predicted depth map."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from jaxtyping import UInt8

from hudepth.base.errors import ConfigError, DataError
from hudepth.base.files import written_whole
from hudepth.inference.depth_map import DepthMap

MAX_JPEG_SIDE = 65_500  # pixels, by libjpeg


@dataclass(frozen=True)
class Style:
    """What all pictures of a run have in common."""

    scale_m: tuple[float, float] | None = None  # ends of the colour scale [m]; None: each picture its own


FORMATS: dict[str, tuple[str, Callable[[DepthMap, IO[bytes], Style], object]]] = {
    "png16": ("_depth.png", lambda depth, file, _: file.write(depth.to_png16())),
    "npy": ("_depth.npy", lambda depth, file, _: file.write(npy(depth))),
    "colour": ("_depth.jpg", lambda depth, file, style: file.write(jpeg(depth.colourise(scale_m=style.scale_m)))),
    "side": ("_side.jpg", lambda depth, file, style: file.write(jpeg(depth.side_by_side(scale_m=style.scale_m)))),
    "ply": ("_depth.ply", lambda depth, file, _: file.write(depth.point_cloud().to_ply())),
}
"""By name: the file's ending, and what writes it; ``png16`` in mm, ``npy`` and ``ply`` in m, others are pictures."""


def write_depth(stem: Path, depth: DepthMap, formats: Sequence[str], style: Style) -> None:
    """Write ``<stem>_depth.png`` and so on in formats of :data:`FORMATS`, each whole or not at all.

    Raises OSError, and DataError, once all others are written, with the formats that cannot hold this picture.
    """
    failed = []
    for name in formats:
        ending, write = FORMATS[name]
        try:
            with written_whole(stem.with_name(stem.name + ending), durable=False) as part, part.open("wb") as file:
                write(depth, file, style)
        except (DataError, ConfigError) as error:
            failed.append(f"no {name}: {error}")
    if failed:
        raise DataError(" ".join(failed))


def npy(depth: DepthMap) -> bytes:
    """Return a depth map in metres as a .npy file. NumPy, writing one itself, does not say why it cannot."""
    memory = io.BytesIO()
    np.save(memory, depth.metres)
    return memory.getvalue()


def jpeg(rgb: UInt8[np.ndarray, "h w 3"], *, quality: int = 92) -> bytes:
    """Return a picture as a JPEG file; raises DataError if it is too wide or too high for one."""
    height, width = rgb.shape[:2]
    if max(height, width) > MAX_JPEG_SIDE:
        raise DataError(f"a JPEG of {width} x {height} pixels, allowed are {MAX_JPEG_SIDE}. Use formats=[png16,npy].")
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
