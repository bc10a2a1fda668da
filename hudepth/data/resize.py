"""How an image comes to a network's size: the same for training, testing and use."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8


def resize_image(image: UInt8[np.ndarray, "H W 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image at another size: averaged over areas where it shrinks, else bilinear.

    Args:
        image: RGB.
        size: (height, width).
    """
    height, width = size
    shrinks = image.shape[0] >= height and image.shape[1] >= width
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), np.uint8)
