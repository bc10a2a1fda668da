"""The look that all plots share: colours, frames, long names cut short."""

from __future__ import annotations

from matplotlib.axes import Axes

COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#8c6d31")
"""Colour-blind safe (Okabe and Ito 2008), except the last: their yellow is too light for a line."""
BLUE, ORANGE = COLOURS[1:3]
"""For pairs: better and worse, a and b."""


def strip_frame(axis: Axes, *sides: str) -> None:
    """Hide the frame on these sides; by default top and right."""
    for side in sides or ("top", "right"):
        axis.spines[side].set_visible(False)


def shorten(text: str, room: int = 34) -> str:
    """Cut the end of a text that has more letters than there is room for."""
    return text if len(text) <= room else f"{text[: room - 1]}…"
