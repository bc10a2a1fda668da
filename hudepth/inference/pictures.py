"""Everything that a model takes for a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from hudepth.base.images import Photo, as_rgb, pillow_rgb, read_photo

Picture = Photo | str | Path | bytes | NDArray[Any] | torch.Tensor | Image.Image
"""An image: one that was read, a path, the bytes of a file, an array (grey, RGB or RGBA of 8 or 16 bits), a tensor of
such numbers, with the channels first or last, or a Pillow image."""


def read_picture(image: Picture) -> Photo:
    """Decode a picture; DataError if it cannot be read, TypeError if it is none."""
    if isinstance(image, torch.Tensor):
        image = _pixels(image)
    if isinstance(image, Photo):
        return image
    if isinstance(image, Image.Image):
        return Photo(pillow_rgb(image), ())
    if isinstance(image, np.ndarray):
        return Photo(as_rgb(image), ())
    if isinstance(image, str | Path | bytes):
        return read_photo(image)
    raise TypeError(f"image: {type(image).__name__}. Pass a path, bytes, array, tensor or Pillow image.")


def _pixels(image: torch.Tensor) -> NDArray[Any]:
    """Return a tensor as an array with the channels last; TypeError if it does not hold the numbers of a picture."""
    if image.dtype not in (torch.uint8, torch.uint16) or image.layout != torch.strided or image.is_meta:
        raise TypeError(
            f"image: a tensor of {str(image.dtype).removeprefix('torch.')}. Pass uint8 or uint16 of shape "
            "[height,width,3] or [3,height,width]; floats from 0 to 1 are (255 * x).round().to(torch.uint8)."
        )
    array: NDArray[Any] = image.cpu().numpy()
    first = array.ndim == 3 and array.shape[0] in (1, 3, 4) and array.shape[2] not in (1, 3, 4)
    return np.moveaxis(array, 0, 2) if first else array
