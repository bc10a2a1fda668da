from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from hudepth.viz.panels import Panel, save_figure
from hudepth.viz.sheet import draw_sheet


def panels(count: int, *, pred_m: float = 2.0) -> list[Panel]:
    rng = np.random.default_rng(0)
    truth = rng.uniform(1, 4, (count, 24, 32)).astype(np.float32)
    image = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
    return [Panel(image, each, np.full((24, 32), pred_m, dtype=np.float32)) for each in truth]


def test_the_sheet_has_a_row_for_image_truth_and_each_network_on_one_scale() -> None:
    name = "boundary_smoothness_and_a_very_long_name_indeed"
    figure = draw_sheet({"paper": panels(3), name: panels(3, pred_m=9.0)}, titles=["a", "b", "c"])
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    box = canvas.get_renderer()
    cells = figure.axes[:-1]
    assert len(cells) == 4 * 3
    scales = {axis.images[0].get_clim() for axis in cells[3:]}
    assert len(scales) == 1
    words = [text for axis in cells for text in axis.texts]
    assert [text.get_text().replace("\n", "") for text in words] == ["image", "ground truth", "paper", name]
    assert min(text.get_window_extent(box).x0 for text in words) >= 0


def test_a_sheet_without_any_truth_is_drawn_all_the_same(tmp_path: Path) -> None:
    unmeasured = [replace(panel, truth_m=np.zeros_like(panel.truth_m)) for panel in panels(1)]
    save_figure(tmp_path / "panels.png", draw_sheet({"x": unmeasured}))
    assert (tmp_path / "panels.png").read_bytes().startswith(b"\x89PNG")
