from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patches import Rectangle

from hudepth.metrics.strata import STRATA, Stratum
from hudepth.viz.strata import draw_strata, save_strata


def make_row(group: str, label: str, *, abs_rel: float = 0.1, share: float = 0.2) -> Stratum:
    return Stratum(group, label, 5, share, abs_rel, 0.5, 0.3, 0.9)


def make_rows(categories: int = 9, *, seed: int = 0) -> list[Stratum]:
    rng = np.random.default_rng(seed)
    pairs = [*STRATA, *(("category", f"category_{i}_of_room") for i in range(categories))]
    return [make_row(*pair, abs_rel=rng.uniform(0.05, 0.3), share=rng.uniform(0, 0.4)) for pair in pairs]


def bars(axis: Axes) -> list[Rectangle]:
    return [patch for patch in axis.patches if isinstance(patch, Rectangle)]


def labels(axis: Axes) -> list[str]:
    return [label.get_text() for label in axis.get_yticklabels()]


def test_a_plot_a_group_and_a_bar_a_bin_from_the_top() -> None:
    rows = make_rows()
    figure = draw_strata(rows, title="eigen protocol")
    assert figure.get_suptitle() == "eigen protocol"
    groups = ["depth", "edge distance", "region", "category"]
    for axis, group in zip(figure.axes, groups, strict=True):
        members = [row for row in rows if row.group == group]
        assert group in axis.get_title(loc="left")
        assert [bar.get_width() for bar in bars(axis)] == [row.abs_rel for row in members]
        assert all(row.label.replace("_", " ") in text for row, text in zip(members, labels(axis), strict=True))
        assert axis.get_ylim()[0] > axis.get_ylim()[1]


def test_the_share_stands_beside_the_name() -> None:
    (axis, _) = draw_strata([make_row("depth", "0-1 m", share=0.004), make_row("depth", "1-2 m", share=0.996)]).axes
    assert [text.split("   ") for text in labels(axis)] == [["0-1 m", "< 1 %"], ["1-2 m", "100 %"]]


def test_all_plots_share_one_scale_from_zero() -> None:
    assert len({axis.get_xlim() for axis in draw_strata(make_rows()).axes}) == 1
    assert draw_strata(make_rows()).axes[0].get_xlim()[0] == 0


def test_a_rare_bin_is_pale_and_does_not_set_the_scale() -> None:
    rows = [make_row("depth", "0-1 m", abs_rel=5.0, share=0.001), make_row("depth", "1-2 m", abs_rel=0.1, share=0.999)]
    axis = draw_strata(rows).axes[0]
    rare, common = bars(axis)
    assert (rare.get_alpha() or 1) < (common.get_alpha() or 1)
    assert 0.1 < axis.get_xlim()[1] < 0.2
    assert [text.get_text().strip() for text in axis.texts] == ["5.000", "0.100"]


@pytest.mark.slow
@pytest.mark.parametrize("categories", [0, 1, 9, 12])
def test_nothing_is_cut_off_and_nothing_overlaps(categories: int) -> None:
    figure = draw_strata(make_rows(categories), title="eigen protocol, 654 test images of nyu_labeled")
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    boxes: list[Any] = [axis.get_tightbbox(renderer) for axis in figure.axes if axis.axison]
    assert len(boxes) == (4 if categories else 3)
    for i, box in enumerate(boxes):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= figure.bbox.width
        assert box.y1 <= figure.bbox.height - 15  # the title's line
        for other in boxes[:i]:
            across = min(box.x1, other.x1) - max(box.x0, other.x0)
            down = min(box.y1, other.y1) - max(box.y0, other.y0)
            assert across <= 1 or down <= 1
    for axis in (axis for axis in figure.axes if axis.axison):
        lines = [label.get_window_extent(renderer) for label in axis.get_yticklabels()]
        assert all(above.y0 >= below.y1 for above, below in pairwise(lines))
        for text in axis.texts:
            assert text.get_window_extent(renderer).x1 <= axis.get_window_extent(renderer).x1


def test_one_group_alone() -> None:
    assert [axis.axison for axis in draw_strata([make_row("depth", "0-1 m")]).axes] == [True, False]


def test_a_picture_is_a_file(tmp_path: Path) -> None:
    path = tmp_path / "new" / "strata.png"
    save_strata(path, make_rows())
    assert path.read_bytes().startswith(b"\x89PNG")
    assert [file.name for file in path.parent.iterdir()] == ["strata.png"]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("abs_rel", [np.nan, np.inf, 0.0])
def test_odd_errors_are_drawn_all_the_same(abs_rel: float) -> None:
    rows = [make_row("depth", "0-1 m", abs_rel=abs_rel), make_row("region", "top left", abs_rel=abs_rel)]
    axes = draw_strata(rows).axes
    assert [text.get_text().strip() for axis in axes for text in axis.texts] == [f"{abs_rel:.3f}"] * 2
    assert all(axis.get_xlim()[0] == 0 < axis.get_xlim()[1] < np.inf for axis in axes if axis.axison)


def test_the_number_of_a_bar_beyond_the_scale_lies_inside() -> None:
    bins = [("0-1 m", 5.0, 0.001), ("1-2 m", 0.1, 0.999), ("2-3 m", 0.112, 0.001)]
    figure = draw_strata([Stratum("depth", n, 5, s, a, 0.5, 0.3, 0.9) for n, a, s in bins])
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    axis = figure.axes[0]
    inside = axis.get_window_extent(canvas.get_renderer())
    for text in axis.texts:
        box = text.get_window_extent(canvas.get_renderer())
        assert inside.x0 <= box.x0
        assert box.x1 <= inside.x1


def test_where_all_are_rare_they_set_the_scale() -> None:
    axis = draw_strata([Stratum("depth", "0-1 m", 5, 0.001, 5.0, 0.5, 0.3, 0.9)]).axes[0]
    assert axis.get_xlim()[1] > 5
