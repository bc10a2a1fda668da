"""How strong the lights of a room are, and what a camera makes of it."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

Range: TypeAlias = tuple[float, float]


class Look(NamedTuple):
    """Ranges from which each room draws its lights, and each picture its camera."""

    fill: Range
    """Strength of the light from a window or lamp; that of the ceiling light is 4 to 7."""
    ambient: Range
    """Strength of the light off the walls: little gives hard shadows."""
    exposure: Range
    """Brightness over that of a well-exposed picture."""
    red: Range
    """Factor of red over green: the error of white balance."""
    blue: Range
    """As ``red``."""
    noise: Range
    """Standard deviation of a pixel, of 255."""
    contrast: Range = (1.0, 1.0)
    """Exponent of values in [0, 1]."""
    blur: float = 0.0
    """Largest standard deviation of blur over the height of the picture."""
    jpeg_quality: Range | None = None
    """Of the compression; None: not compressed."""


STUDIO = Look((0.4, 2.2), (0.35, 0.6), (0.5, 1.6), (0.94, 1.08), (0.9, 1.08), (1.0, 4.0))
"""A good camera in even light."""
SNAPSHOT = Look(
    (0.2, 6.0), (0.08, 0.6), (0.3, 2.4), (0.75, 1.3), (0.65, 1.25), (0.5, 5.0),
    contrast=(0.75, 1.6), blur=0.005, jpeg_quality=(30, 95),
)  # fmt: skip
"""A phone in whatever light there is."""
