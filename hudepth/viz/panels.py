"""Pictures of predictions: RGB, ground truth, prediction and error side by side, on one scale in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray

from hudepth.base.files import written_whole
from hudepth.viz.colour import DEPTH_COLOURS, ERROR_COLOURS, colour_map

MIN_SPAN_M = 0.1
"""Least width of a scale."""


@dataclass(frozen=True)
class Panel:
    """One row of a picture."""

    image: NDArray[np.uint8]
    """[h, w, 3] RGB."""
    truth_m: NDArray[np.float32]
    """[h, w] metres, 0 where unmeasured (shown grey)."""
    pred_m: NDArray[np.float32]
    """[h, w] metres."""
    title: str = ""


def draw_panels(panels: Sequence[Panel]) -> NDArray[np.uint8]:
    """Draw RGB, ground truth, prediction and absolute error of at least one panel, a row each; return [H, W, 3] RGB.

    Rows share a depth scale, from the smallest to the largest ground truth, and an error scale, up to the 99th
    percentile.
    """
    canvas: Any = FigureCanvasAgg(_literal(_figure(panels)))
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def save_panels(path: Path, panels: Sequence[Panel]) -> None:
    """Write :func:`draw_panels` as a PNG file, whole or not at all."""
    save_figure(path, _figure(panels))


def save_figure(path: Path, figure: Figure) -> None:
    """Write a figure as a PNG file, whole or not at all."""
    FigureCanvasAgg(_literal(figure))
    with written_whole(path) as part:
        figure.savefig(part, format="png")


def _literal(figure: Figure) -> Figure:
    """Turn off formulas: matplotlib parses text between dollar signs, and fails if it is not a formula."""
    for text in figure.findobj(Text):
        text.set_parse_math(False)
    return figure


def _figure(panels: Sequence[Panel]) -> Figure:
    measured = np.concatenate([panel.truth_m[panel.truth_m > 0] for panel in panels])
    low, high = (float(measured.min()), float(measured.max())) if measured.size else (0.0, 1.0)
    if high - low < MIN_SPAN_M:  # one depth everywhere
        low, high = max(0.0, low - MIN_SPAN_M / 2), low + MIN_SPAN_M / 2
    errors = [np.ma.masked_where(panel.truth_m <= 0, np.abs(panel.pred_m - panel.truth_m)) for panel in panels]
    wrongs = np.concatenate([error.compressed() for error in errors])
    wrongs = wrongs[np.isfinite(wrongs)]
    worst = max(MIN_SPAN_M, float(np.percentile(wrongs, 99))) if wrongs.size else 1.0  # not the maximum

    figure, cells, bars = _layout(len(panels), aspect=panels[0].image.shape[0] / panels[0].image.shape[1])
    for title, cell in zip(("image", "truth", "prediction", "absolute error"), cells[0], strict=True):
        cell.set_title(title, fontsize=11, pad=5)
    depth_scale: dict[str, Any] = {"cmap": colour_map(DEPTH_COLOURS), "vmin": low, "vmax": high}
    for row, panel, error in zip(cells, panels, errors, strict=True):
        row[0].imshow(panel.image)
        row[1].imshow(np.ma.masked_where(panel.truth_m <= 0, panel.truth_m), **depth_scale)
        depth = row[2].imshow(panel.pred_m, **depth_scale)
        wrong = row[3].imshow(error, cmap=colour_map(ERROR_COLOURS), vmin=0, vmax=worst)
        row[0].set_ylabel(_shorten(panel.title, row[0]), fontsize=8)
    figure.colorbar(depth, cax=bars[0], orientation="horizontal", extend="both", label="depth [m]")
    figure.colorbar(wrong, cax=bars[1], orientation="horizontal", extend="max", label="absolute error [m]")
    return figure


def _layout(rows: int, *, aspect: float) -> tuple[Figure, list[list[Axes]], list[Axes]]:
    """Return a figure, its rows of four cells, and the axes of the two scales below; all placed in inches."""
    cell, gap, left, top, bottom, bar = 2.6, 0.07, 0.3, 0.32, 0.62, 0.11
    width = left + 4 * cell + 3 * gap + 0.1
    height = top + rows * (cell * aspect + gap) + bottom
    figure = Figure(figsize=(width, height), dpi=110)

    def axes(x: float, y: float, w: float, h: float) -> Axes:
        return figure.add_axes((x / width, y / height, w / width, h / height))

    x = [left + column * (cell + gap) for column in range(4)]
    ys = [height - top - (row + 1) * cell * aspect - row * gap for row in range(rows)]
    cells = [[axes(each, y, cell, cell * aspect) for each in x] for y in ys]
    for axis in (axis for row in cells for axis in row):
        axis.set(xticks=[], yticks=[])
    y = bottom - bar - 0.02
    inset = 0.2  # of a scale's ends from its columns
    bars = [axes(x[1] + inset, y, 2 * cell + gap - 2 * inset, bar), axes(x[3] + inset, y, cell - 2 * inset, bar)]
    for scale in bars:
        scale.tick_params(labelsize=9)
    return figure, cells, bars


def _shorten(title: str, axis: Axes) -> str:
    """Cut the front of a title that is longer than its row is high; frame numbers are at the end."""
    figure = axis.get_figure()
    assert figure is not None
    room = int(axis.get_position().height * figure.bbox.height / figure.dpi * 15)  # 15 letters of 8 points per inch
    return title if len(title) <= room else f"…{title[len(title) - room + 1 :]}"
