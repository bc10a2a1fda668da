"""The input of all contenders: a few images of built-in rooms."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from hudepth.base.files import written_whole
from hudepth.base.images import resize_image
from hudepth.base.normalise import NormaliseBytes
from hudepth.data.sources.rooms import RoomsSource

COUNT = 8


@cache
def rooms() -> list[UInt8[np.ndarray, "h w 3"]]:
    """Return :data:`COUNT` images, each of another room."""
    source = RoomsSource(scenes=COUNT, frames_per_scene=1)
    return [source.read(record).image for record in source.records()]


def images_file(folder: Path, size: tuple[int, int]) -> Path:
    """Return a .npy file of the rooms, normalised, float32 [n, 3, h, w], in ``folder``; written if missing."""
    path = folder / f"images_{size[0]}x{size[1]}.npy"
    if not path.exists():
        rgb = torch.from_numpy(np.stack([resize_image(image, size) for image in rooms()]))
        with written_whole(path, durable=False) as part, part.open("wb") as file:
            np.save(file, NormaliseBytes()(rgb).contiguous().numpy())
    return path
