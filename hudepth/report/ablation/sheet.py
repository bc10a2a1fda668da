"""The same images under several networks: images as columns, a row each for image, truth and every network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hudepth.viz.panels import DEPTH_COLOURS, MIN_SPAN_M, UNMEASURED_COLOUR, Panel, save_figure


def draw_sheet(predictions: Mapping[str, Sequence[Panel]], *, titles: Sequence[str] = ()) -> Figure:
    """Draw images, their truth, and what each network predicts, on one metre scale.

    Args:
        predictions: by network, a panel for each image, the same images in the same order.
        titles: of the images.
    """
    first = next(iter(predictions.values()))
    measured = np.concatenate([panel.truth_m[panel.truth_m > 0] for panel in first])
    low, high = (float(measured.min()), float(measured.max())) if measured.size else (0.0, 1.0)
    scale: dict[str, Any] = {"vmin": low, "vmax": max(high, low + MIN_SPAN_M)}
    scale["cmap"] = colormaps[DEPTH_COLOURS].with_extremes(bad=UNMEASURED_COLOUR)
    figure, cells, bar = _layout(
        2 + len(predictions), len(first), aspect=first[0].image.shape[0] / first[0].image.shape[1]
    )
    for column, panel in enumerate(first):
        cells[0][column].imshow(panel.image)
        truth = cells[1][column].imshow(np.ma.masked_where(panel.truth_m <= 0, panel.truth_m), **scale)
        if column < len(titles):
            cells[0][column].set_title(titles[column], fontsize=9, pad=4)
    for row, panels in zip(cells[2:], predictions.values(), strict=True):
        for axis, panel in zip(row, panels, strict=True):
            axis.imshow(panel.pred_m, **scale)
    for row, label in zip(cells, ("image", "truth", *predictions), strict=True):
        row[0].text(-0.05, 0.5, _lines(label), transform=row[0].transAxes, ha="right", va="center", fontsize=9.5)
    figure.colorbar(truth, cax=bar, orientation="horizontal", extend="both", label="depth [m]")
    return figure


def save_sheet(path: Path, predictions: Mapping[str, Sequence[Panel]], *, titles: Sequence[str] = ()) -> None:
    """Write :func:`draw_sheet` as a PNG file, whole or not at all."""
    save_figure(path, draw_sheet(predictions, titles=titles))


def _layout(rows: int, columns: int, *, aspect: float) -> tuple[Figure, list[list[Axes]], Axes]:
    """Return a figure with its cells, and below them the axes of the scale; placed in inches, as panels are."""
    cell, gap, left, top, bottom = 2.0, 0.06, 1.7, 0.32, 0.62
    width = left + columns * (cell + gap) + 0.1
    height = top + rows * (cell * aspect + gap) + bottom
    figure = Figure(figsize=(width, height), dpi=110)

    def axes(x: float, y: float, w: float, h: float) -> Axes:
        return figure.add_axes((x / width, y / height, w / width, h / height))

    cells = [
        [
            axes(left + c * (cell + gap), height - top - (r + 1) * cell * aspect - r * gap, cell, cell * aspect)
            for c in range(columns)
        ]
        for r in range(rows)
    ]
    for axis in (axis for row in cells for axis in row):
        axis.set_xticks([])
        axis.set_yticks([])
    bar = axes(left + 0.2, bottom - 0.13, columns * (cell + gap) - gap - 0.4, 0.11)
    bar.tick_params(labelsize=9)
    return figure, cells, bar


def _lines(label: str, *, room: int = 17) -> str:
    """Break a label into lines that fit beside a row."""
    lines, rest = [], label
    while len(rest) > room:
        cut = max(rest.rfind(mark, 1, room + 1) for mark in " _,-/")
        cut = room if cut < 1 else cut + 1
        lines.append(rest[:cut].rstrip())
        rest = rest[cut:].lstrip()
    return "\n".join([*lines, rest][:4])
