"""The pinhole camera, and that of NYU Depth V2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from hudepth.base.errors import ConfigError

_NYU_FX, _NYU_FY, _NYU_CX, _NYU_CY = 518.857901, 519.469611, 325.582449, 253.736166
_NYU_WIDTH, _NYU_HEIGHT = 640, 480

CameraOption = Annotated[tuple[float, float, float, float], "[fx,fy,cx,cy] in pixels of the images"]
"""A camera as an option: the arguments of :class:`Intrinsics`."""


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
    """False where NYU's camera stands in for one that nobody stated."""

    def __post_init__(self) -> None:
        if not (0 < self.fx < np.inf and 0 < self.fy < np.inf and np.isfinite(self.cx) and np.isfinite(self.cy)):
            raise ConfigError(
                f"intrinsics: [{self.fx},{self.fy},{self.cx},{self.cy}] is not a camera. "
                "Pass intrinsics=[fx,fy,cx,cy] in pixels of the image."
            )

    @classmethod
    def of_nyu(cls, height: int, width: int) -> Intrinsics:
        """Return those of NYU's colour camera for frames of another size.

        Each axis is scaled by itself, as when an NYU frame is resized to ``height`` x ``width``: the field of view
        stays the same, whatever the aspect ratio.
        """
        nyu = cls(_NYU_FX, _NYU_FY, _NYU_CX, _NYU_CY, known=False)
        return nyu.scale(width / _NYU_WIDTH, height / _NYU_HEIGHT)

    @classmethod
    def of_photo(cls, height: int, width: int) -> Intrinsics:
        """Return NYU's camera for a photograph: with square pixels where it has not the shape of NYU's frames.

        The longer side then has the field of view of NYU's, and the principal point is the centre.
        """
        if abs(width / height / (_NYU_WIDTH / _NYU_HEIGHT) - 1) < 0.01:
            return cls.of_nyu(height, width)
        focal = _NYU_FX * max(height, width) / _NYU_WIDTH
        return cls(focal, focal, (width - 1) / 2, (height - 1) / 2, known=False)

    def check_fit(self, height: int, width: int) -> None:
        """Refuse a camera that cannot have taken a picture of this size, as one in millimetres.

        Raises:
            ConfigError: if a focal length is not 0.2 to 10 times the longer side or the principal point is outside.
        """
        longer, inside = max(height, width), -0.5 <= self.cx < width and -0.5 <= self.cy < height
        if not (inside and all(0.2 * longer <= focal <= 10 * longer for focal in (self.fx, self.fy))):
            raise ConfigError(
                f"intrinsics: [{self.fx:g},{self.fy:g},{self.cx:g},{self.cy:g}] cannot be of a picture of "
                f"{width} x {height}. Pass intrinsics=[fx,fy,cx,cy] in pixels of this picture, not in millimetres."
            )

    def scale(self, x: float, y: float) -> Intrinsics:
        """Return the camera of the same picture at ``x`` times the width and ``y`` times the height."""
        cx, cy = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return Intrinsics(self.fx * x, self.fy * y, cx, cy, known=self.known)
