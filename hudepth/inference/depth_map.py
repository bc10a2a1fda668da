"""A predicted depth map, and its conversion to files, pictures and points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from hudepth.base.camera import Intrinsics
from hudepth.base.errors import DataError
from hudepth.data.store import MAX_STORED, MM_PER_M, to_mm
from hudepth.viz.colour import colour_depth
from hudepth.viz.point_cloud import PointCloud, point_cloud

FAST_PNG = (
    cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP,
)  # fmt: skip
"""A fifth larger than with OpenCV's defaults, in half the time, which counts next to a network that takes 50 ms."""


def _camera(values: Sequence[float] | NDArray[Any]) -> Intrinsics:
    try:
        numbers = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape == (3, 3):
        numbers = numbers[[0, 1, 0, 1], [0, 1, 2, 2]]
    if numbers.shape != (4,):
        raise TypeError("intrinsics: pass (fx, fy, cx, cy) as a tuple, list or array, or a 3 x 3 camera matrix.")
    fx, fy, cx, cy = (float(number) for number in numbers)
    return Intrinsics(fx, fy, cx, cy)


@dataclass(frozen=True)
class DepthMap:
    """The depth of each pixel of an image."""

    metres: Float[np.ndarray, "h w"]  # distance along the optical axis [m], float32
    image: UInt8[np.ndarray, "h w 3"]  # the image it was predicted from, upright, RGB
    max_depth_m: float  # maximum depth the model can predict [m]
    notes: tuple[str, ...] = ()  # what reading changed in the image, if it is not obvious

    def to_png16(self) -> bytes:
        """Return a 16-bit PNG file in millimetres, as NYU, ScanNet and Kinect tools use: rounded.

        Raises DataError if a depth is beyond 65.535 m, the most that such a file holds.
        """
        if round((largest := float(self.metres.max(initial=0))) * MM_PER_M) > MAX_STORED:
            raise DataError(f"depth of {largest:.5g} m, 16-bit millimetres hold 65.535 m. Use formats=[npy].")
        return cv2.imencode(".png", to_mm(self.metres), FAST_PNG)[1].tobytes()

    def colourise(
        self, *, scale_m: tuple[float, float] | None = None, legend: bool = True
    ) -> UInt8[np.ndarray, "h w2 3"]:
        """Return depth as RGB colours, near red and far blue, with a legend in metres.

        The scale is 0 to ``max_depth_m`` [m] by default; raises ConfigError if its ends are not two rising numbers.
        """
        return colour_depth(self.metres, scale_m=scale_m or (0.0, self.max_depth_m), legend=legend)

    def side_by_side(self, *, scale_m: tuple[float, float] | None = None) -> UInt8[np.ndarray, "h w2 3"]:
        """Return the image with its coloured depth to the right."""
        return np.hstack([self.image, self.colourise(scale_m=scale_m)])

    def point_cloud(self, intrinsics: Intrinsics | Sequence[float] | NDArray[Any] | None = None) -> PointCloud:
        """Return one coloured point per pixel.

        ``intrinsics`` are (fx, fy, cx, cy) or a 3 x 3 camera matrix, in pixels; by default NYU's, scaled. Raises
        ConfigError if they cannot be of this picture, TypeError if they are no such numbers.
        """
        camera = intrinsics if intrinsics is None or isinstance(intrinsics, Intrinsics) else _camera(intrinsics)
        if camera is not None:
            camera.check_fit(*self.metres.shape)
        return point_cloud(self.metres, self.image, camera)
