"""A predicted depth map, and its conversion to files, pictures and points."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from hudepth.base.camera import CameraChoice, CameraLike, Intrinsics
from hudepth.base.errors import DataError
from hudepth.data.store import MAX_STORED, MM_PER_M, to_mm
from hudepth.viz.colour import auto_scale, colour_depth
from hudepth.viz.point_cloud import PointCloud, point_cloud

FAST_PNG = (
    cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP,
)  # fmt: skip
"""A fifth larger than with OpenCV's defaults, in half the time, which counts next to a network that takes 50 ms."""


@dataclass(frozen=True)
class DepthMap:
    """The depth of each pixel of an image."""

    metres: Float[np.ndarray, "h w"]  # distance along the optical axis [m], float32
    image: UInt8[np.ndarray, "h w 3"]  # the image it was predicted from, upright, RGB
    max_depth_m: float  # maximum depth the model can predict for this camera [m]
    notes: tuple[str, ...] = ()  # what reading changed in the image, if it is not obvious
    camera: Intrinsics | None = None  # which took the image, in its pixels, or is assumed; None: NYU's is
    camera_factor: float = 1.0  # by which the network's depth was multiplied for that camera

    @property
    def whose_camera(self) -> str:
        """Whose camera was used, and what it did to the depth, in words."""
        origin = (self.camera or Intrinsics.of_photo(*self.metres.shape)).origin
        return f"{origin}{self._factor_words}"

    @property
    def _factor_words(self) -> str:
        return "" if self.camera_factor == 1 else f"; depth x {self.camera_factor:.3f} for it"

    def to_png16(self) -> bytes:
        """Return a 16-bit PNG file in millimetres, as NYU, ScanNet and Kinect tools use: rounded.

        Its text ``camera`` states the camera. Raises DataError if a depth is beyond 65.535 m, the most that such a
        file holds.
        """
        if round((largest := float(self.metres.max(initial=0))) * MM_PER_M) > MAX_STORED:
            raise DataError(f"depth of {largest:.5g} m, 16-bit millimetres hold 65.535 m. Use formats=[npy].")
        data = cv2.imencode(".png", to_mm(self.metres), FAST_PNG)[1].tobytes()
        if self.camera is None:
            return data
        text = b"tEXtcamera\0" + f"{self.camera}{self._factor_words}".encode("latin-1", "replace")
        chunk = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
        return data[:33] + chunk + data[33:]  # after the signature and the header

    def colourise(
        self, *, scale_m: tuple[float, float] | None = None, legend: bool = True
    ) -> UInt8[np.ndarray, "h w2 3"]:
        """Return depth as RGB colours, near red and far blue, with a legend in metres.

        The scale [m] is by default that of :func:`hudepth.viz.colour.auto_scale`; raises ConfigError if its ends are
        not two rising numbers.
        """
        return colour_depth(self.metres, scale_m=scale_m or auto_scale(self.metres), legend=legend)

    def side_by_side(self, *, scale_m: tuple[float, float] | None = None) -> UInt8[np.ndarray, "h w2 3"]:
        """Return the image with its coloured depth to the right; ``scale_m`` as in :meth:`colourise`."""
        return np.hstack([self.image, self.colourise(scale_m=scale_m)])

    def point_cloud(self, camera: CameraLike | None = None) -> PointCloud:
        """Return one coloured point per pixel, by default with the camera that the depth was predicted for.

        Another ``camera``, as :func:`hudepth.load` takes it, moves the points to the sides and leaves depth as it is.
        Raises ConfigError if it cannot be of this picture, TypeError if it is no camera.
        """
        shape = self.metres.shape
        chosen = None if camera is None else CameraChoice.of(camera).of_picture(*shape)
        if chosen is not None:
            return point_cloud(self.metres, self.image, chosen)
        cloud = point_cloud(self.metres, self.image, self.camera)
        return replace(cloud, comment=cloud.comment + self._factor_words)
