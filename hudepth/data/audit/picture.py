"""Picture of leaks: test images beside the training images most like them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hudepth.viz.panels import save_figure

COLOURS = {"near": "tab:red", "scene": "tab:orange", "other": "0.35"}
"""Of the verdict: near duplicates, images of one scene, and others."""


@dataclass(frozen=True)
class Leak:
    """A test image and the training image most like it."""

    test: NDArray[np.uint8]
    """[h, w, 3] RGB."""
    train: NDArray[np.uint8]
    """[h, w, 3] RGB."""
    test_id: str
    train_id: str
    verdict: str
    """How near the two are: a few short lines."""
    grade: str
    """``near`` (duplicates), ``scene`` (the same) or ``other``: the verdict's colour."""


def draw_leaks(leaks: Sequence[Leak], *, title: str) -> Figure:
    """Draw one row a leak: the test image, the training image, and how near they are.

    Args:
        leaks: at least one.
        title: above the rows; lines are not broken.
    """
    cell, gap, text, label = 2.2, 0.1, 2.0, 0.22  # inches: rows of any number and shape keep gaps and letters
    top, bottom = 0.35 + 0.16 * title.count("\n"), 0.08
    cell_height = cell * leaks[0].test.shape[0] / leaks[0].test.shape[1]
    width = 3 * gap + 2 * cell + text
    height = top + len(leaks) * (cell_height + label) + bottom
    figure = Figure(figsize=(width, height), dpi=110)
    figure.text(gap / width, 1 - 0.1 / height, title, va="top", fontsize=9)
    for row, leak in enumerate(leaks):
        y = height - top - (row + 1) * (cell_height + label)
        for column, (image, name) in enumerate(((leak.test, leak.test_id), (leak.train, leak.train_id))):
            x = gap + column * (cell + gap)
            axis = figure.add_axes((x / width, y / height, cell / width, cell_height / height))
            _show(axis, image, f"{('test', 'training')[column]}  {_end(name, 30 - 4 * column)}")
        figure.text(
            (3 * gap + 2 * cell) / width,
            (y + cell_height / 2) / height,
            leak.verdict,
            va="center",
            fontsize=9,
            linespacing=1.5,
            color=COLOURS[leak.grade],
        )
    return figure


def save_leaks(path: Path, leaks: Sequence[Leak], *, title: str) -> None:
    """Write :func:`draw_leaks` as a PNG file, whole or not at all."""
    save_figure(path, draw_leaks(leaks, title=title))


def _show(axis: Axes, image: NDArray[np.uint8], name: str) -> None:
    axis.imshow(image)
    axis.set_title(name, fontsize=8, loc="left", pad=3)
    axis.set_xticks([])
    axis.set_yticks([])


def _end(name: str, room: int) -> str:
    """Cut the front of a name that is too long: frame numbers stand at the end."""
    return name if len(name) <= room else f"…{name[len(name) - room + 1 :]}"
