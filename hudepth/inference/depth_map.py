"""A predicted depth map, and its conversion to files, pictures and points."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from hudepth.base.camera import CameraChoice, CameraLike, Intrinsics
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.files import written_whole
from hudepth.data.store import MAX_STORED, MM_PER_M, to_mm
from hudepth.viz.colour import auto_scale, colour_depth
from hudepth.viz.point_cloud import PointCloud, point_cloud

FAST_PNG = (
    cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP,
)  # fmt: skip
"""A fifth larger than with OpenCV's defaults, in half the time, which counts next to a network that takes 50 ms."""

MAX_JPEG_SIDE = 65_500
"""Pixels, by libjpeg."""


@dataclass(frozen=True, eq=False, repr=False)
class DepthMap:
    """The depth of each pixel of an image."""

    metres: Float[np.ndarray, "h w"]  #: distance along the optical axis [m], float32
    image: UInt8[np.ndarray, "h w 3"]  #: the image it was predicted from, upright, RGB
    max_depth_m: float  #: maximum depth the model can predict for this camera [m]
    notes: tuple[str, ...] = ()  #: what reading changed in the image, if it is not obvious
    camera: Intrinsics | None = None  #: which took the image, in its pixels, or is assumed; None: NYU's is
    camera_factor: float = 1.0  #: by which the network's depth was multiplied for that camera
    uncertainty_m: Float[np.ndarray, "h w"] | None = None  #: with flip: half the difference of the two predictions [m]

    def __repr__(self) -> str:
        height, width = self.metres.shape
        ends = f"{self.metres.min():.2f} to {self.metres.max():.2f} m" if self.metres.size else "empty"
        return f"DepthMap({height} x {width}, {ends}, {self.whose_camera})"

    def __eq__(self, other: object) -> bool:
        """Whether depth, image and everything else are the same."""
        if not isinstance(other, DepthMap):
            return NotImplemented
        pairs = ((getattr(self, each.name), getattr(other, each.name)) for each in fields(self))
        return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in pairs)

    __hash__ = None  # type: ignore[assignment]  # as that of arrays

    def save(self, path: str | Path) -> None:
        """Write a file whose suffix says what: depth in ``.png`` (16-bit millimetres) or ``.npy`` (metres), points in
        ``.ply`` or ``.glb``, or a coloured picture in ``.jpg``.

        Raises ConfigError for another suffix, DataError if the file cannot hold this picture, OSError.
        """
        path = Path(path).expanduser()
        if (make := SUFFIXES.get(path.suffix.lower())) is None:
            raise ConfigError(f"save: '{path.name}' has none of the endings {', '.join(SUFFIXES)}.")
        data = make(self)  # before anything is written
        with written_whole(path, durable=False) as part:
            part.write_bytes(data)

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

    def point_cloud(
        self, camera: CameraLike | None = None, *, edges: bool = False, max_uncertainty: float | None = None
    ) -> PointCloud:
        """Return one coloured point per pixel, by default with the camera that the depth was predicted for.

        ``edges`` false leaves out pixels at depth edges, whose points fly between two surfaces; ``max_uncertainty``
        those whose uncertainty exceeds this share of their depth. Another ``camera``, as
        :func:`hudepth.load` takes it, moves the points to the sides and leaves depth as it is. Raises ConfigError if it
        cannot be of this picture, TypeError if it is no camera.
        """
        sure = None
        if max_uncertainty is not None:
            sure = self._uncertainty() <= np.float32(max_uncertainty) * self.metres
        shape = self.metres.shape
        chosen = None if camera is None else CameraChoice.of(camera).of_picture(*shape)
        if chosen is not None:
            return point_cloud(self.metres, self.image, chosen, edges=edges, kept=sure)
        cloud = point_cloud(self.metres, self.image, self.camera, edges=edges, kept=sure)
        return replace(cloud, comment=cloud.comment + self._factor_words)

    def to_npy(self) -> bytes:
        """Return a .npy file in metres."""
        return _npy(self.metres)

    def uncertainty_to_npy(self) -> bytes:
        """Return the uncertainty as a .npy file in metres; ConfigError if there is none."""
        return _npy(self._uncertainty())

    def _uncertainty(self) -> Float[np.ndarray, "h w"]:
        if self.uncertainty_m is None:
            raise ConfigError("uncertainty needs the mirrored image's prediction, too. Pass flip=true.")
        return self.uncertainty_m


def _npy(metres: Float[np.ndarray, "h w"]) -> bytes:
    """Return a .npy file. NumPy, writing one itself, does not say why it cannot."""
    memory = io.BytesIO()
    np.save(memory, metres)
    return memory.getvalue()


def jpeg(rgb: UInt8[np.ndarray, "h w 3"], *, quality: int = 92) -> bytes:
    """Return a picture as a JPEG file; raises DataError if it is too wide or too high for one."""
    height, width = rgb.shape[:2]
    if max(height, width) > MAX_JPEG_SIDE:
        raise DataError(f"a JPEG of {width} x {height} pixels, allowed are {MAX_JPEG_SIDE}. Use formats=[png16,npy].")
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


SUFFIXES: dict[str, Callable[[DepthMap], bytes]] = {
    ".png": DepthMap.to_png16,
    ".npy": DepthMap.to_npy,
    ".ply": lambda depth: depth.point_cloud().to_ply(),
    ".glb": lambda depth: depth.point_cloud().to_glb(),
    ".jpg": lambda depth: jpeg(depth.colourise()),
    ".jpeg": lambda depth: jpeg(depth.colourise()),
}
"""What :meth:`DepthMap.save` writes."""
