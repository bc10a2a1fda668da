from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hudepth.report.scatter import draw_comparison
from hudepth.viz.panels import save_figure

IDS = ["near", "far", "same", "bad", "worst"]
A = np.array([0.1, 0.4, 0.2, np.nan, 0.9])
B = np.array([0.2, 0.3, 0.2, 0.5, 0.1])


def draw(**options: Any) -> Figure:
    return draw_comparison(IDS, A, B, **{"shown": ["bad", "worst", "near"], **options})


def points(axis: Axes) -> dict[str, NDArray[np.float64]]:
    found = {}
    for collection in axis.collections:
        assert isinstance(collection, PathCollection)
        found[str(collection.get_label())] = np.asarray(collection.get_offsets())
    return found


def test_each_image_is_a_point_on_the_side_of_the_better() -> None:
    drawn = points(draw().axes[0])
    assert drawn["a better: 1 images"].tolist() == [[0.1, 0.2]]
    assert drawn["b better: 2 images"].tolist() == [[0.4, 0.3], [0.9, 0.1]]
    assert drawn["equal: 1 images"].tolist() == [[0.2, 0.2]]
    assert [0.9, 0.1] in drawn["shown on the right"].tolist()


def test_no_word_of_equal_images_where_there_are_none() -> None:
    figure = draw_comparison(IDS[:2], A[:2], B[:2], shown=["far"])
    assert set(points(figure.axes[0])) == {"a better: 1 images", "b better: 1 images", "shown on the right"}


def test_both_axes_have_one_scale_that_holds_every_point() -> None:
    axis = draw().axes[0]
    assert axis.get_xlim() == axis.get_ylim()
    assert axis.get_xlim()[0] == 0
    assert axis.get_xlim()[1] > 0.9
    assert axis.get_aspect() == 1
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("abs_rel under a", "abs_rel under b")


def test_bars_are_pairs_from_the_top_in_the_order_given() -> None:
    axis = draw(metric="rmse").axes[1]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["bad", "worst", "near"]
    assert axis.get_ylim()[0] > axis.get_ylim()[1]
    widths = {container.get_label(): [bar.get_width() for bar in container] for container in axis.containers}  # type: ignore[attr-defined]
    assert widths == {"a": [0, 0.9, 0.1], "b": [0.5, 0.1, 0.2]}
    assert [text.get_text().strip() for text in axis.texts] == ["nan"]
    assert axis.get_xlabel() == "rmse (smaller is better)"
    assert axis.get_title() == "the 3 images that differ most"


def test_a_long_id_keeps_its_end() -> None:
    name = "scenes/" + "very_" * 20 + "long/frame_0042"
    axis = draw_comparison([name], A[:1], B[:1], shown=[name]).axes[1]
    label = axis.get_yticklabels()[0].get_text()
    assert len(label) == 32
    assert label.startswith("…")
    assert label.endswith("long/frame_0042")


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3, 12])
def test_nothing_is_cut_off_and_the_plots_do_not_overlap(count: int) -> None:
    rng = np.random.default_rng(0)
    ids = [f"a_rather_long_name_of_a_room/frame_{i:05d}" for i in range(40)]
    title = "a: runs/badcl/2025-08-11_12-00-00\nb: runs/silog/2025-08-12_12-00-00"
    figure = draw_comparison(ids, rng.random(40), rng.random(40), shown=ids[:count], title=title)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    boxes: list[Any] = [axis.get_tightbbox(canvas.get_renderer()) for axis in figure.axes]
    assert boxes[0].x0 >= 0
    assert boxes[0].x1 <= boxes[1].x0
    assert boxes[1].x1 <= figure.bbox.width
    assert min(box.y0 for box in boxes) >= 0
    assert max(box.y1 for box in boxes) < figure.bbox.height - 20  # the title's lines


@pytest.mark.parametrize("values", [[0.0, 0.0], [np.nan, np.nan], [np.inf, 0.5]])
def test_odd_values_are_drawn_all_the_same(tmp_path: Path, values: list[float]) -> None:
    path = tmp_path / "new" / "compare.png"
    save_figure(path, draw_comparison(["x", "y"], np.array(values), np.array([0.0, 0.0]), shown=["x", "y"]))
    assert path.read_bytes().startswith(b"\x89PNG")
