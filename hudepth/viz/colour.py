"""The colour scales of all pictures, and depth painted on a fixed scale in metres with a legend."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from hudepth.base.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

DEPTH_COLOURS = "turbo_r"
"""Near is red, far is blue."""
ERROR_COLOURS = "magma"
SCORE_COLOURS = "viridis"
"""Bright is better."""
UNMEASURED_COLOUR, UNMEASURED_GREY = "0.75", 191
"""A light grey that no scale contains, for matplotlib and in bytes."""


def colour_map(name: str) -> Colormap:
    """Return a scale as matplotlib's colour map; masked values are grey."""
    from matplotlib import colormaps

    return colormaps[name].with_extremes(bad=UNMEASURED_COLOUR)


def colour_depth(
    depth_m: Float[np.ndarray, "h w"], *, scale_m: tuple[float, float], legend: bool = True
) -> UInt8[np.ndarray, "h w2 3"]:
    """Paint depth (0 where unmeasured) in RGB on a fixed scale, by default with a legend appended on the right.

    ``scale_m`` holds the depths of the two ends of :data:`DEPTH_COLOURS`; depths beyond them are clipped. Raises
    ConfigError if they are not two increasing numbers.
    """
    near, far = (float(end) for end in scale_m)
    if not 0 <= near < far < np.inf:
        raise ConfigError(f"scale_m: {scale_m} is not two increasing depths in metres. Pass scale_m=[0,10].")
    shade = cv2.convertScaleAbs(depth_m - near if near else depth_m, alpha=255 / (far - near))  # rounds, clips at 255
    if near:
        shade[depth_m < near] = 0
    picture = cv2.applyColorMap(shade, _colours())
    if not depth_m.all():
        picture[depth_m == 0] = UNMEASURED_GREY
    return np.hstack([picture, _legend(depth_m.shape[0], near, far)]) if legend else np.asarray(picture, np.uint8)


@lru_cache(maxsize=1)
def _colours() -> UInt8[np.ndarray, "256 1 3"]:
    """Return the depth scale as a lookup table for OpenCV, in RGB."""
    ramp = np.arange(256, dtype=np.uint8)[::-1, None]
    return np.ascontiguousarray(cv2.applyColorMap(ramp, cv2.COLORMAP_TURBO)[..., ::-1])


@lru_cache(maxsize=8)
def _legend(height: int, near: float, far: float) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the scale, as high as the picture; pictures of one size share it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    dpi = float(np.clip(height / 4, 40, 200))
    width = max(round(0.62 * dpi), 24)
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi)
    margin = min(0.12 * dpi / height, 0.2)
    bar = figure.add_axes((0.08, margin, 0.25, 1 - 2 * margin))
    bar.imshow(_colours()[:, ::1].astype(float) / 255, aspect="auto", extent=(0, 1, far, near))
    bar.set_xticks([])
    bar.yaxis.tick_right()
    bar.tick_params(labelsize=8, length=2, pad=2)
    bar.set_ylabel("depth [m]", fontsize=8, labelpad=2)
    bar.yaxis.set_label_position("right")
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())[:height, :, :3]
    return np.ascontiguousarray(cv2.resize(drawn, (drawn.shape[1], height)), np.uint8)
