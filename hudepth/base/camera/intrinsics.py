"""The pinhole camera, and that of NYU Depth V2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import ConfigError

_NYU_FX, _NYU_FY, _NYU_CX, _NYU_CY = 518.857901, 519.469611, 325.582449, 253.736166
_NYU_WIDTH, _NYU_HEIGHT = 640, 480

NYU_FOCAL = (_NYU_FX / _NYU_WIDTH, _NYU_FY / _NYU_HEIGHT)
"""Focal lengths of NYU's colour camera: the horizontal one over the width, the vertical one over the height."""
NYU_ASSUMED = "NYU Depth V2's, assumed"


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion."""

    fx: float
    """Focal length [pixels]."""
    fy: float
    cx: float
    """Principal point [pixels], from the centre of the first pixel."""
    cy: float
    known: bool = True
    """False where the training camera stands in for one that nobody stated."""
    origin: str = "as given"
    """Whose it is, in words."""

    def __post_init__(self) -> None:
        if not (0 < self.fx < np.inf and 0 < self.fy < np.inf and np.isfinite(self.cx) and np.isfinite(self.cy)):
            raise ConfigError(
                f"camera: [{self.fx},{self.fy},{self.cx},{self.cy}] is not a camera. "
                "Pass camera=[fx,fy,cx,cy] in pixels of the image."
            )

    @classmethod
    def of(cls, values: Intrinsics | Sequence[float] | NDArray[Any]) -> Intrinsics:
        """Return (fx, fy, cx, cy) or a 3 x 3 camera matrix as intrinsics; TypeError if they are no such numbers."""
        if isinstance(values, Intrinsics):
            return values
        try:
            numbers = np.asarray(values, np.float64)
        except (TypeError, ValueError):
            numbers = np.empty(0)
        if numbers.shape == (3, 3):
            numbers = numbers[[0, 1, 0, 1], [0, 1, 2, 2]]
        if numbers.shape != (4,):
            raise TypeError("camera: pass (fx, fy, cx, cy) as a tuple, list or array, or a 3 x 3 camera matrix.")
        fx, fy, cx, cy = numbers.tolist()
        return cls(fx, fy, cx, cy)

    @classmethod
    def of_nyu(cls, height: int, width: int) -> Intrinsics:
        """Return those of NYU's colour camera for frames of another size.

        Each axis is scaled by itself, as when an NYU frame is resized to ``height`` x ``width``: the field of view
        stays the same, whatever the aspect ratio.
        """
        nyu = cls(_NYU_FX, _NYU_FY, _NYU_CX, _NYU_CY, known=False, origin=NYU_ASSUMED)
        return nyu.scale(width / _NYU_WIDTH, height / _NYU_HEIGHT)

    @classmethod
    def of_photo(cls, height: int, width: int) -> Intrinsics:
        """Return NYU's camera for a photograph: with square pixels where it has not the shape of NYU's frames.

        The longer side then has the field of view of NYU's, and the principal point is the centre.
        """
        if abs(width / height / (_NYU_WIDTH / _NYU_HEIGHT) - 1) < 0.01:
            return cls.of_nyu(height, width)
        focal = _NYU_FX * max(height, width) / _NYU_WIDTH
        return cls.centred(focal, focal, height, width, known=False, origin=NYU_ASSUMED)

    @classmethod
    def centred(
        cls, fx: float, fy: float, height: int, width: int, *, origin: str = "as given", known: bool = True
    ) -> Intrinsics:
        """Return a camera whose principal point is the centre of a picture of ``height`` x ``width``."""
        return cls(fx, fy, (width - 1) / 2, (height - 1) / 2, known=known, origin=origin)

    @property
    def numbers(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) [pixels]."""
        return self.fx, self.fy, self.cx, self.cy

    def fits(self, height: int, width: int) -> bool:
        """Tell whether it can have taken a picture of this size, unlike one in millimetres.

        Focal lengths are 0.2 to 10 times the longer side, and the principal point is inside.
        """
        longer, inside = max(height, width), -0.5 <= self.cx < width and -0.5 <= self.cy < height
        return inside and all(0.2 * longer <= focal <= 10 * longer for focal in (self.fx, self.fy))

    def check_fit(self, height: int, width: int) -> None:
        """Raise ConfigError if it cannot have taken a picture of this size; see :meth:`fits`."""
        if not self.fits(height, width):
            raise ConfigError(
                f"camera: [{self.fx:g},{self.fy:g},{self.cx:g},{self.cy:g}] cannot be of a picture of "
                f"{width} x {height}. Pass camera=[fx,fy,cx,cy] in pixels of this picture, not in millimetres."
            )

    def scale(self, x: float, y: float) -> Intrinsics:
        """Return the camera of the same picture at ``x`` times the width and ``y`` times the height."""
        cx, cy = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return Intrinsics(self.fx * x, self.fy * y, cx, cy, known=self.known, origin=self.origin)

    def __str__(self) -> str:
        return f"fx {self.fx:.3f} fy {self.fy:.3f} cx {self.cx:.3f} cy {self.cy:.3f} pixels, {self.origin}"
