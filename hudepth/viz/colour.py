"""The colour scales of all pictures, and depth painted on a fixed scale in metres with a legend."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from hudepth.base.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.colors import Colormap
    from PIL import ImageFont

DEPTH_COLOURS = "turbo_r"
"""Near is red, far is blue."""
ERROR_COLOURS = "magma"
SCORE_COLOURS = "viridis"
"""Bright is better."""
MIN_LEGEND = 48
"""Height of a picture [pixels] below which a legend would not be legible."""
UNMEASURED_COLOUR, UNMEASURED_GREY = "0.75", 191
"""A light grey that no scale contains, for matplotlib and in bytes."""


def colour_map(name: str) -> Colormap:
    """Return a scale as matplotlib's colour map; masked values are grey."""
    from matplotlib import colormaps

    return colormaps[name].with_extremes(bad=UNMEASURED_COLOUR)


def auto_scale(depth_m: Float[np.ndarray, "h w"]) -> tuple[float, float]:
    """Return the ends of a colour scale [m] that spends its colours on one picture.

    They are the 2nd and 98th percentile of measured depth (above 0), but at least a fifth of their mean apart: the
    unevenness of a flat wall should not look like a landscape.
    """
    step = max(1, round((depth_m.size / 100_000) ** 0.5))  # as many pixels are enough for percentiles
    measured = depth_m[::step, ::step]
    measured = measured[measured > 0]
    if not len(measured):
        return 0.0, 1.0
    near, far = (float(end) for end in np.percentile(measured, (2, 98)))
    half, middle = (far - near) / 2, (far + near) / 2
    half = max(half, 0.1 * middle)
    return middle - half, middle + half


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
    if not legend or len(depth_m) < MIN_LEGEND:
        return np.asarray(picture, np.uint8)
    return np.hstack([picture, _legend(len(depth_m), near, far)])


@lru_cache(maxsize=1)
def _colours() -> UInt8[np.ndarray, "256 1 3"]:
    """Return the depth scale as a lookup table for OpenCV, in RGB."""
    ramp = np.arange(256, dtype=np.uint8)[::-1, None]
    return np.ascontiguousarray(cv2.applyColorMap(ramp, cv2.COLORMAP_TURBO)[..., ::-1])


@lru_cache(maxsize=8)
def _legend(height: int, near: float, far: float) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the scale, as high as the picture; pictures of one size and scale share it.

    With Pillow, in a millisecond: matplotlib takes half as long as the network, and most pictures have their own scale.
    """
    from matplotlib.ticker import MaxNLocator
    from PIL import Image, ImageDraw

    unit = max(height / 4, 80) / 72  # pixels per point; digits are at least 9 pixels high
    font = _font(round(8 * unit))
    locator = MaxNLocator(nbins=min(9, max(1, height // 18)), steps=[1, 2, 2.5, 5, 10])
    ticks = [tick for tick in locator.tick_values(near, far) if near <= tick <= far]
    decimals = max((len(f"{tick:.6g}".partition(".")[2]) for tick in ticks), default=0)
    texts = [f"{tick:.{decimals}f}" for tick in ticks]
    bar, gap, margin = round(9 * unit), round(3 * unit), round(min(9 * unit, 0.2 * height))
    ascent = round(font.getbbox("0")[3])
    width = gap + bar + gap + round(max((font.getlength(text) for text in texts), default=0)) + gap + ascent + gap
    picture = Image.new("RGB", (max(width, 24), height), "white")
    length = max(1, height - 2 * margin)
    picture.paste(
        Image.fromarray(cv2.resize(_colours(), (bar, length), interpolation=cv2.INTER_NEAREST)), (gap, margin)
    )
    draw = ImageDraw.Draw(picture)
    draw.rectangle((gap, margin, gap + bar, margin + length), outline="black")
    for tick, text in zip(ticks, texts, strict=True):
        y = margin + length * (tick - near) / (far - near)
        draw.line((gap + bar, y, gap + bar + gap // 2, y), fill="black")
        draw.text((gap + bar + gap, y), text, fill="black", font=font, anchor="lm")
    label = Image.new("L", (round(font.getlength("depth [m]")) + 2, ascent + gap), 0)
    ImageDraw.Draw(label).text((1, 0), "depth [m]", fill=255, font=font)
    turned = label.rotate(90, expand=True)
    picture.paste("black", (picture.width - turned.width, (height - turned.height) // 2), turned)
    return np.ascontiguousarray(picture, np.uint8)


@lru_cache(maxsize=8)
def _font(size: int) -> ImageFont.FreeTypeFont:
    from matplotlib import get_data_path
    from PIL import ImageFont

    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)
