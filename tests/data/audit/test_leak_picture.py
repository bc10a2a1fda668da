"""The picture of leaks: which image stands where, in what words and colours, and that nothing is cut off."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hudepth.data.audit.leak_picture import COLOURS, LeakRow, draw_leaks

TITLE = "nyu_raw, split=random: what leaks\na second line\nand a third"


def make_leak(
    *, test_id: str = "kitchen_0004/17", grade: str = "near", shape: tuple[int, int] = (24, 32), value: int = 200
) -> LeakRow:
    images = np.stack([np.full((*shape, 3), colour, np.uint8) for colour in ((value, 10, 10), (10, 10, value))])
    names = (test_id, "kitchen_0004/18")
    return LeakRow(images, names, "3 of 64 hash bits differ\nsame scene, 1 frame apart", grade)


def drawn(figure: Figure) -> NDArray[np.uint8]:
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def test_test_stands_left_of_training() -> None:
    figure = draw_leaks([make_leak(), make_leak(value=100)], title=TITLE)
    rgb = drawn(figure)
    centres = []
    for axis in figure.axes:
        box = axis.get_window_extent()
        centres.append(rgb[len(rgb) - int(box.y0 + box.height / 2), int(box.x0 + box.width / 2)].tolist())
    assert centres == [[200, 10, 10], [10, 10, 200], [100, 10, 10], [10, 10, 100]]
    boxes = [axis.get_window_extent() for axis in figure.axes]
    assert boxes[0].x1 < boxes[1].x0
    assert boxes[2].y1 < boxes[0].y0


def test_names_verdicts_and_title_are_written() -> None:
    figure = draw_leaks([make_leak(), make_leak(grade="other")], title=TITLE)
    assert [axis.get_title(loc="left") for axis in figure.axes[:2]] == [
        "test  kitchen_0004/17",
        "training  kitchen_0004/18",
    ]
    title, near, other = figure.texts
    assert title.get_text() == TITLE
    assert near.get_text().startswith("3 of 64 hash bits differ")
    assert (near.get_color(), other.get_color()) == (COLOURS["near"], COLOURS["other"])


def test_a_long_name_keeps_its_end() -> None:
    figure = draw_leaks([make_leak(test_id="x" * 90 + "/living_room_0029/123")], title="")
    name = figure.axes[0].get_title(loc="left")
    assert name.startswith("test  …")
    assert name.endswith("/living_room_0029/123")


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(24, 32), (32, 24), (32, 32)])
@pytest.mark.parametrize("rows", [1, 6])
def test_nothing_is_cut_off_and_nothing_overlaps(rows: int, shape: tuple[int, int]) -> None:
    figure = draw_leaks([make_leak(shape=shape, test_id="living_room_0029_out/" * 4)] * rows, title=TITLE)
    drawn(figure)
    canvas: Any = figure.canvas
    renderer = canvas.get_renderer()
    boxes = [axis.get_tightbbox(renderer) for axis in figure.axes]
    boxes += [text.get_window_extent(renderer) for text in figure.texts]
    for i, box in enumerate(boxes):
        assert box is not None
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= figure.bbox.width
        assert box.y1 <= figure.bbox.height
        for other in boxes[:i]:
            assert other is not None
            across = min(box.x1, other.x1) - max(box.x0, other.x0)
            down = min(box.y1, other.y1) - max(box.y0, other.y0)
            assert across <= 1 or down <= 1
