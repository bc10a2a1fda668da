"""Resize an image of any size and shape to the network's input, and its depth back, in the metres of its camera."""

from __future__ import annotations

from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from hudepth.base.camera import Intrinsics
from hudepth.base.images import resize_image
from hudepth.base.normalise import IMAGENET_MEAN

Fit = Literal["stretch", "letterbox"]
"""``stretch`` resizes the whole image to the network's input, as in training. ``letterbox`` first pads it with grey to
the shape of the training images: proportions stay as the network knows them, at the price of resolution."""


FOCAL_POWERS = (0.15, 0.6)
"""Powers of the ratios of focal lengths, horizontal and vertical, by which a network's depth is multiplied. They are
measured on crops of NYU's training images with the bundled model (``experiments/field_of_view``): a room that is cut
left and right looks as far as before, and one that is cut on all sides less near than it is enlarged."""


class Fitted(NamedTuple):
    """An image at the network's size."""

    rgb: UInt8[np.ndarray, "h w 3"]
    box: tuple[slice, slice]  # rows and columns that the image fills


def fit_image(image: UInt8[np.ndarray, "H W 3"], size: tuple[int, int], *, fit: Fit, aspect: float) -> Fitted:
    """Resize an RGB image to the network's (height, width); ``letterbox`` pads to ``aspect``, width over height."""
    height, width = size
    relative = image.shape[1] / image.shape[0] / aspect  # above 1: wider than the training images
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
    """Resize the depth of a fitted image to the image's own (height, width), bilinearly."""
    inside = np.ascontiguousarray(depth_m[box])
    return np.asarray(cv2.resize(inside, (size[1], size[0]), interpolation=cv2.INTER_LINEAR), np.float32)


def camera_factor(
    camera: Intrinsics, fitted: Fitted, size: tuple[int, int], training_focal: tuple[float, float]
) -> float:
    """Return by what a network's depth is multiplied for a picture of another camera than that of its training.

    What appears twice as large is half as far, or was taken with twice the focal length. Were size all that a network
    goes by, depth would have to be multiplied by the ratio of focal lengths at its input (the canonical camera of Yin
    et al., Metric3D, ICCV 2023). It also goes by what else a picture shows, so the ratios count with the powers
    :data:`FOCAL_POWERS`.

    Args:
        camera: in pixels of the picture.
        fitted: the picture at the network's size.
        size: (height, width) of the picture.
        training_focal: focal lengths of the training camera over the sides of its pictures, horizontal and vertical.
    """
    (rows, columns), (height, width) = fitted.box, fitted.rgb.shape[:2]
    across = camera.fx / size[1] * (columns.stop - columns.start) / (training_focal[0] * width)
    down = camera.fy / size[0] * (rows.stop - rows.start) / (training_focal[1] * height)
    return float(across ** FOCAL_POWERS[0] * down ** FOCAL_POWERS[1])
