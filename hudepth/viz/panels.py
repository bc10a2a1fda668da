"""Pictures of predictions: RGB, truth, prediction and error side by side, on one metre scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hudepth.files import written_whole

DEPTH_COLOURS = "turbo_r"
"""Near is red, far is blue."""
ERROR_COLOURS = "magma"


@dataclass(frozen=True)
class Panel:
    """One row of a picture."""

    image: NDArray[np.uint8]
    """[h, w, 3] RGB."""
    truth_m: NDArray[np.float32]
    """[h, w] metres, 0 where unmeasured (shown white)."""
    pred_m: NDArray[np.float32]
    """[h, w] metres."""
    title: str = ""


def draw_panels(panels: Sequence[Panel]) -> NDArray[np.uint8]:
    """Draw one row a panel: RGB, truth, prediction, absolute error.

    All depths share one scale, from the smallest to the largest truth, and all errors another, so that rows compare.

    Args:
        panels: at least one.

    Returns:
        [H, W, 3] RGB.
    """
    canvas: Any = FigureCanvasAgg(_figure(panels))
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def save_panels(path: Path, panels: Sequence[Panel]) -> None:
    """Write :func:`draw_panels` as a PNG file, whole or not at all."""
    save_figure(path, _figure(panels))


def save_figure(path: Path, figure: Figure) -> None:
    """Write a figure as a PNG file, whole or not at all."""
    FigureCanvasAgg(figure)
    with written_whole(path) as part:
        figure.savefig(part, format="png")


def _figure(panels: Sequence[Panel]) -> Figure:
    measured = np.concatenate([panel.truth_m[panel.truth_m > 0] for panel in panels])
    low, high = (float(measured.min()), float(measured.max())) if measured.size else (0.0, 1.0)
    errors = [np.ma.masked_where(panel.truth_m <= 0, np.abs(panel.pred_m - panel.truth_m)) for panel in panels]
    wrongs = np.concatenate([error.compressed() for error in errors])
    worst = max(0.1, float(np.percentile(wrongs, 99))) if wrongs.size else 1.0  # outliers should not darken the rest

    height, width = panels[0].image.shape[:2]
    figure = Figure(figsize=(10.5, 0.7 + 2.35 * height / width * len(panels)), dpi=110, layout="constrained")
    axes = figure.subplots(len(panels), 4, squeeze=False)
    for title, axis in zip(("image", "truth", "prediction", "absolute error"), axes[0], strict=True):
        axis.set_title(title, fontsize=10)
    for row, panel, error in zip(axes, panels, errors, strict=True):
        row[0].imshow(panel.image)
        truth = np.ma.masked_where(panel.truth_m <= 0, panel.truth_m)
        depth = row[1].imshow(truth, cmap=DEPTH_COLOURS, vmin=low, vmax=high)
        row[2].imshow(panel.pred_m, cmap=DEPTH_COLOURS, vmin=low, vmax=high)
        wrong = row[3].imshow(error, cmap=ERROR_COLOURS, vmin=0, vmax=worst)
        row[0].set_ylabel(panel.title, fontsize=8)
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    figure.colorbar(depth, ax=axes[:, 1:3], location="bottom", label="depth [m]", shrink=0.6, aspect=40)
    figure.colorbar(wrong, ax=axes[:, 3:], location="bottom", label="error [m]", shrink=0.9)
    return figure
