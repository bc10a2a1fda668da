"""Picture of leaks: test images next to the training images most like them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

COLOURS = {"near": "tab:red", "scene": "tab:orange", "other": "0.35"}


@dataclass(frozen=True)
class LeakRow:
    """A test image and the training image most like it; the grade, a key of ``COLOURS``, colours the verdict."""

    images: NDArray[np.uint8]
    """[2, h, w, 3] RGB, the test image first."""
    names: Sequence[str]
    verdict: str
    grade: str


def draw_leaks(rows: Sequence[LeakRow], *, title: str) -> Figure:
    """Draw the test image, the training image and the verdict of each row, at least one, below the title."""
    cell, gap, text, label = 2.2, 0.1, 2.0, 0.22  # inches: gaps and letters keep their size at any number of rows
    top, bottom = 0.35 + 0.16 * title.count("\n"), 0.08
    cell_height = cell * rows[0].images.shape[1] / rows[0].images.shape[2]
    width = 3 * gap + 2 * cell + text
    height = top + len(rows) * (cell_height + label) + bottom
    figure = Figure(figsize=(width, height), dpi=110)
    figure.text(gap / width, 1 - 0.1 / height, title, va="top", fontsize=9)
    for i, row in enumerate(rows):
        y = height - top - (i + 1) * (cell_height + label)
        for column, (image, name) in enumerate(zip(row.images, row.names, strict=True)):
            x = gap + column * (cell + gap)
            axis = figure.add_axes((x / width, y / height, cell / width, cell_height / height), xticks=[], yticks=[])
            axis.imshow(image)
            heading = f"{('test', 'training')[column]}  {_keep_end(name, 30 - 4 * column)}"
            axis.set_title(heading, fontsize=8, loc="left", pad=3)
        x, y = (3 * gap + 2 * cell) / width, (y + cell_height / 2) / height
        figure.text(x, y, row.verdict, va="center", fontsize=9, linespacing=1.5, color=COLOURS[row.grade])
    return figure


def _keep_end(name: str, room: int) -> str:
    """Cut the front of a name that is too long: frame numbers stand at the end."""
    return name if len(name) <= room else f"…{name[len(name) - room + 1 :]}"
