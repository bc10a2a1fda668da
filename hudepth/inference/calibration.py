"""A correction of a model's metres that was fitted on a few measured depths, and travels with the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hudepth.base.options import Range

Depth = TypeVar("Depth", Tensor, NDArray[np.float32], NDArray[np.float64], float)
Focal = Annotated[float, Range(0.1, 20)]
"""A focal length over a side of the picture."""


@dataclass(frozen=True)
class Calibration:
    """Depth becomes ``scale`` * depth ** ``power`` [m]: a scale and shift of its logarithm."""

    scale: Annotated[float, Range(1e-3, 1e3)]
    power: Annotated[float, Range(0.1, 10)] = 1.0
    """1 for a scale alone."""
    fitted_on: str = ""
    """What it was fitted on, in words."""
    focal: tuple[Focal, Focal] | None = None
    """Focal lengths of the camera of these pictures over their sides, horizontal and vertical; None: not known."""

    def apply(self, depth_m: Depth) -> Depth:
        """Return corrected depth [m], of the same type."""
        powered: Depth = depth_m if self.power == 1 else depth_m**self.power
        return powered * self.scale

    def __str__(self) -> str:
        power = "" if self.power == 1 else f"^{self.power:.3f}"
        words = " ".join(self.fitted_on[:100].split())
        return f"calibrated on {words}: {self.scale:.3f} depth{power}"
