"""Pictures of a sweep: effects, curves, heat map, cost, predictions."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from hudepth.report.ablation.cost import Cost, draw_cost
from hudepth.report.ablation.effects import COLOURS, draw_effects
from hudepth.report.ablation.estimates import Estimate, Interval
from hudepth.report.ablation.heatmap import draw_heatmap, find_grid
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.variants import band, draw_variants
from hudepth.viz.limits import usual_range
from hudepth.viz.panels import Panel, save_figure
from hudepth.viz.sheet import draw_sheet


def rendered(figure: Figure) -> Any:
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas.get_renderer()


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ([1, 2, 3], (1, 3)),
        ([1, 2, 3, 1000], (1, 3)),
        ([-900, 1, 2, 3, math.nan, math.inf], (1, 3)),
        ([2, 2, 2, 9], (2, 9)),
        ([], (0, 1)),
        ([5], (5, 5)),
    ],
)
def test_what_is_far_out_does_not_set_the_scale(values: list[float], ends: tuple[float, float]) -> None:
    assert usual_range(values) == ends


def test_effects_have_a_dot_a_row_at_its_difference_in_the_colour_of_its_verdict(report: Report) -> None:
    figure = draw_effects(report)
    rendered(figure)
    assert [axis.get_title() for axis in figure.axes] == ["abs_rel", "rmse [m]", "delta1", "edge_f1_0.25"]
    rows = [row for row in report.rows if row.contrasts]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [row.label for row in rows]
    dots = next(c for c in figure.axes[1].collections if isinstance(c, PathCollection) and c.get_zorder() == 4)
    places = np.asarray(dots.get_offsets())
    assert places[:, 0] == pytest.approx([row.contrasts["rmse"].value for row in rows])
    inks = [to_hex(colour) for colour in np.asarray(dots.get_facecolor())]
    assert inks == [to_hex(COLOURS[row.contrasts["rmse"].verdict]) for row in rows]


def test_a_difference_far_out_is_written_at_the_edge(report: Report) -> None:
    rows = []
    for row in report.rows:
        changed = {
            name: replace(each, value=5.0) if row.label == "neither" else each for name, each in row.contrasts.items()
        }
        rows.append(replace(row, contrasts=changed))
    axis = draw_effects(replace(report, rows=rows)).axes[1]
    assert [text.get_text() for text in axis.texts] == ["+5.000 →"]
    assert axis.get_xlim()[1] < 1


def history(*values: float) -> list[dict[str, float]]:
    return [{"epoch": float(e), "val/abs_rel": v} for e, v in enumerate(values, start=1)]


def test_a_band_is_of_the_epochs_that_all_seeds_have() -> None:
    epochs, mean, low, high = band([history(0.3, 0.2, 0.1), history(0.5, 0.4)], "val/abs_rel")
    assert epochs.tolist() == [1, 2]
    assert mean == pytest.approx([0.4, 0.3])
    assert (low.tolist(), high.tolist()) == ([0.3, 0.2], [0.5, 0.4])


def test_curves_name_the_chosen_and_count_the_others() -> None:
    histories = {f"r{i}": [history(0.3, 0.2 + i / 1000), history(0.31, 0.21)] for i in range(30)}
    figure = draw_variants(histories, shown=["r3", "r0"])
    rendered(figure)
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words == ["28 others", "r3", "r0"]


def test_a_curve_outside_the_plot_says_so() -> None:
    histories = {"a": [history(0.3, 0.2)], "b": [history(0.3, 0.21)], "c": [history(0.3, 0.22)], "d": [history(9, 8)]}
    figure = draw_variants(histories, shown=list(histories))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b", "c", "d (outside)"]
    assert figure.axes[0].get_ylim()[1] < 1


def test_the_heat_map_writes_each_mean_and_rings_the_best(report: Report) -> None:
    grid = find_grid(report.rows)
    assert grid is not None
    figure = draw_heatmap(grid)
    rendered(figure)
    means = {row.label: row.estimates["abs_rel"].mean for row in report.rows}
    order = ("neither", "no_smooth", "no_scale", "paper")  # y, then x
    assert [text.get_text() for text in figure.axes[0].texts] == [f"{means[name]:.4f}" for name in order]
    bold = [text.get_text() for text in figure.axes[0].texts if text.get_fontweight() == "bold"]
    assert bold == [f"{min(means[name] for name in order):.4f}"]
    assert len(figure.axes[0].patches) == 1


def test_cost_has_a_point_a_row_and_keeps_those_far_out_in_sight() -> None:
    def cost(label: str, mean: float) -> Cost:
        return Cost(
            label, 2_000_000, 3_000_000_000, Estimate({"1": mean}, mean, Interval(mean - 0.01, mean + 0.01), Interval())
        )

    figure = draw_cost([cost("a", 0.2), cost("b", 0.21), cost("c", 0.22), cost("d", 4.0)])
    rendered(figure)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b", "c", "d"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["4.000"]
    assert [axis.get_xlabel() for axis in figure.axes] == [
        "parameters [millions]",
        "multiply-adds per image [billions]",
    ]


def panels(count: int, *, pred_m: float = 2.0) -> list[Panel]:
    rng = np.random.default_rng(0)
    truth = rng.uniform(1, 4, (count, 24, 32)).astype(np.float32)
    image = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
    return [Panel(image, each, np.full((24, 32), pred_m, dtype=np.float32)) for each in truth]


def test_the_sheet_has_a_row_for_image_truth_and_each_network_on_one_scale() -> None:
    name = "boundary_smoothness_and_a_very_long_name_indeed"
    figure = draw_sheet({"paper": panels(3), name: panels(3, pred_m=9.0)}, titles=["a", "b", "c"])
    box = rendered(figure)
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
