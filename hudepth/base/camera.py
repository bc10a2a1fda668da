"""The pinhole camera, and that of NYU Depth V2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hudepth.base.errors import ConfigError

_NYU_FX, _NYU_FY, _NYU_CX, _NYU_CY = 518.857901, 519.469611, 325.582449, 253.736166
_NYU_WIDTH, _NYU_HEIGHT = 640, 480


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
                f"intrinsics: [{self.fx},{self.fy},{self.cx},{self.cy}] is no camera. "
                "Pass intrinsics=[fx,fy,cx,cy] in pixels of the image."
            )

    @classmethod
    def of_nyu(cls, height: int, width: int) -> Intrinsics:
        """Return those of NYU's colour camera for frames of another size.

        Each axis is scaled by itself, as when an NYU frame is resized to ``height`` x ``width``: the field of view
        stays the same, whatever the aspect ratio.
        """
        sx, sy = width / _NYU_WIDTH, height / _NYU_HEIGHT
        return cls(_NYU_FX * sx, _NYU_FY * sy, (_NYU_CX + 0.5) * sx - 0.5, (_NYU_CY + 0.5) * sy - 0.5, known=False)


def intrinsics(value: Any) -> Intrinsics | None:
    """Return the camera that a configuration states, if it does.

    Args:
        value: ``[fx, fy, cx, cy]`` or None.

    Raises:
        ConfigError: if it is neither.
    """
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 4 or not all(isinstance(entry, int | float) for entry in value):
        raise ConfigError(f"intrinsics: {value} is not [fx,fy,cx,cy]. Pass four numbers, in pixels of the images.")
    fx, fy, cx, cy = (float(entry) for entry in value)
    return Intrinsics(fx, fy, cx, cy)
