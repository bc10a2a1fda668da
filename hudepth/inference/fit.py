"""From an image of any size and shape to what the network takes, and back."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.base.images import resize_image
from hudepth.base.normalise import IMAGENET_MEAN

FITS = ("stretch", "letterbox")
"""``stretch`` gives the whole image the network's size, as in training. ``letterbox`` first pads it with grey to the
shape of the training images, so that things keep the proportions the network knows, at the price of resolution."""


class Fitted(NamedTuple):
    """An image at the network's size."""

    rgb: UInt8[np.ndarray, "h w 3"]
    box: tuple[slice, slice]
    """Rows and columns of it that the image fills."""


def check_fit(fit: str) -> str:
    """Return ``fit``.

    Raises:
        ConfigError: if there is no such way.
    """
    if fit not in FITS:
        raise ConfigError(f"fit: no '{fit}'.{did_you_mean(fit, FITS)} Pass one of {', '.join(FITS)}.")
    return fit


def fit_image(image: UInt8[np.ndarray, "H W 3"], size: tuple[int, int], *, fit: str, aspect: float) -> Fitted:
    """Bring an image to the network's size.

    Args:
        image: RGB.
        size: (height, width) the network takes.
        fit: one of :data:`FITS`.
        aspect: width over height of the images it was trained on, before they were resized.
    """
    height, width = size
    relative = image.shape[1] / image.shape[0] / aspect  # how much wider than the training images it is
    if fit == "stretch" or relative == 1:
        return Fitted(resize_image(image, size), (slice(0, height), slice(0, width)))
    rows = max(1, round(height / max(relative, 1)))
    columns = max(1, round(width * min(relative, 1)))
    top, left = (height - rows) // 2, (width - columns) // 2
    box = (slice(top, top + rows), slice(left, left + columns))
    canvas = np.empty((height, width, 3), np.uint8)
    canvas[:] = [round(255 * mean) for mean in IMAGENET_MEAN]
    canvas[box] = resize_image(image, (rows, columns))
    return Fitted(canvas, box)


def unfit_depth(
    depth_m: Float[np.ndarray, "h w"], box: tuple[slice, slice], size: tuple[int, int]
) -> Float[np.ndarray, "H W"]:
    """Bring the depth of a fitted image to the image's own size, bilinearly.

    Args:
        depth_m: at the network's size [m].
        box: where the image lies in it.
        size: (height, width) of the image.
    """
    inside = np.ascontiguousarray(depth_m[box])
    return np.asarray(cv2.resize(inside, (size[1], size[0]), interpolation=cv2.INTER_LINEAR), np.float32)
