"""The same images under several networks: one column per image, a row each for image, ground truth and networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hudepth.viz.colour import DEPTH_COLOURS, colour_map
from hudepth.viz.panels import MIN_SPAN_M, Panel


def draw_sheet(predictions: Mapping[str, Sequence[Panel]], *, titles: Sequence[str] = ()) -> Figure:
    """Draw images, their ground truth, and the panels of each network, in the same order, on one scale in metres."""
    first = next(iter(predictions.values()))
    measured = np.concatenate([panel.truth_m[panel.truth_m > 0] for panel in first])
    low, high = (float(measured.min()), float(measured.max())) if measured.size else (0.0, 1.0)
    scale: dict[str, Any] = {"vmin": low, "vmax": max(high, low + MIN_SPAN_M)}
    scale["cmap"] = colour_map(DEPTH_COLOURS)
    truths = [np.ma.masked_where(panel.truth_m <= 0, panel.truth_m) for panel in first]
    rows: dict[str, Sequence[Any]] = {"image": [panel.image for panel in first], "ground truth": truths}
    rows |= {name: [panel.pred_m for panel in panels] for name, panels in predictions.items()}

    # placed in inches: with any number of rows and columns, gaps and letters keep their size
    cell, gap, left, top, bottom = 2.0, 0.06, 1.7, 0.32, 0.62
    tall = cell * first[0].image.shape[0] / first[0].image.shape[1]
    width, height = left + len(first) * (cell + gap) + 0.1, top + len(rows) * (tall + gap) + bottom
    figure = Figure(figsize=(width, height), dpi=110)
    for row, (label, images) in enumerate(rows.items()):
        y = height - top - (row + 1) * tall - row * gap
        for column, image in enumerate(images):
            x = left + column * (cell + gap)
            axis = figure.add_axes((x / width, y / height, cell / width, tall / height))
            drawn = axis.imshow(image, **(scale if row else {}))
            axis.set(xticks=[], yticks=[])
            if row == 0 and column < len(titles):
                axis.set_title(titles[column], fontsize=9, pad=4)
            if column == 0:
                where: dict[str, Any] = {"transform": axis.transAxes, "ha": "right", "va": "center", "fontsize": 9.5}
                axis.text(-0.05, 0.5, _wrap(label), **where)
    span = len(first) * (cell + gap) - gap - 0.4
    bar = figure.add_axes(((left + 0.2) / width, (bottom - 0.13) / height, span / width, 0.11 / height))
    bar.tick_params(labelsize=9)
    figure.colorbar(drawn, cax=bar, orientation="horizontal", extend="both", label="depth [m]")
    return figure


def _wrap(label: str, *, room: int = 17) -> str:
    """Break a label into at most four lines that fit next to a row."""
    lines, rest = [], label
    while len(rest) > room:
        cut = max(rest.rfind(mark, 1, room + 1) for mark in " _,-/")
        cut = room if cut < 1 else cut + 1
        lines.append(rest[:cut].rstrip())
        rest = rest[cut:].lstrip()
    return "\n".join([*lines, rest][:4])
