"""Pictures of a sweep: effects, curves, heat map."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from hudepth.report.ablation.effects import COLOURS, draw_effects
from hudepth.report.ablation.heatmap import draw_heatmap, find_grid
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.variants import band, draw_variants


def rendered(figure: Figure) -> Any:
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas.get_renderer()


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
