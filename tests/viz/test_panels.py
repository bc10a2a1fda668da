from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray

from hudepth.viz import panels as module
from hudepth.viz.colour import DEPTH_COLOURS, ERROR_COLOURS
from hudepth.viz.panels import Panel, draw_panels, save_figure, save_panels

GREY = np.full(3, 191)  # of unmeasured pixels: 0.75 of 255
F32 = NDArray[np.float32]


def make_panel(
    truth_m: F32 | None = None, pred_m: F32 | None = None, *, height: int = 24, width: int = 32, title: str = "a/0"
) -> Panel:
    ramp = np.tile(np.linspace(1, 5, width, dtype=np.float32), (height, 1))
    image = np.full((height, width, 3), (10, 200, 30), np.uint8)
    return Panel(image, ramp if truth_m is None else truth_m, ramp if pred_m is None else pred_m, title=title)


class Picture:
    """A drawn picture with the places of its cells."""

    def __init__(self, *panels: Panel, monkeypatch: pytest.MonkeyPatch) -> None:
        figures: list[Figure] = []
        figure = module._figure

        def kept(panels: Any) -> Figure:
            figures.append(figure(panels))
            return figures[-1]

        with monkeypatch.context() as patch:
            patch.setattr(module, "_figure", kept)
            self.rgb = draw_panels(panels)
        (self.figure,) = figures

    def cell(self, row: int, column: int) -> NDArray[np.uint8]:
        """Return the pixels inside the frame of a cell."""
        box = self.figure.axes[4 * row + column].get_window_extent()
        height = len(self.rgb)
        return self.rgb[int(height - box.y1) + 3 : int(height - box.y0) - 3, int(box.x0) + 3 : int(box.x1) - 3]


def colour(name: str, share: float) -> NDArray[np.float64]:
    return np.array(colormaps[name](share)[:3]) * 255


def centre(cell: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return cell[len(cell) // 2, cell.shape[1] // 2]


@pytest.mark.parametrize("rows", [1, 2])
def test_a_picture_is_rgb(rows: int) -> None:
    picture = draw_panels([make_panel()] * rows)
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape[2] == 3
    assert picture.flags.c_contiguous
    assert picture[::7, ::7].std(axis=(0, 1)).min() > 10


def test_each_row_adds_the_same_height() -> None:
    heights = [len(draw_panels([make_panel()] * rows)) for rows in (1, 2, 4)]
    step = heights[1] - heights[0]
    assert heights[2] - heights[1] == pytest.approx(2 * step, abs=2)


def test_what_stands_where(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = np.full((24, 32), 4, np.float32)
    truth[0, 0], truth[0, 1] = 2, 6  # the ends of the scale
    pred = np.full((24, 32), 5, np.float32)
    picture = Picture(make_panel(truth, pred), monkeypatch=monkeypatch)
    assert centre(picture.cell(0, 0)).tolist() == [10, 200, 30]
    np.testing.assert_allclose(centre(picture.cell(0, 1)), colour(DEPTH_COLOURS, 0.5), atol=2)
    np.testing.assert_allclose(centre(picture.cell(0, 2)), colour(DEPTH_COLOURS, 0.75), atol=2)
    worst = np.percentile(np.abs(pred - truth), 99)
    np.testing.assert_allclose(centre(picture.cell(0, 3)), colour(ERROR_COLOURS, 1 / worst), atol=2)


def test_rows_share_one_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = (np.full((24, 32), depth, np.float32) for depth in (1, 9))
    picture = Picture(make_panel(near, near), make_panel(far, near), monkeypatch=monkeypatch)
    np.testing.assert_allclose(centre(picture.cell(0, 1)), colour(DEPTH_COLOURS, 0.0), atol=2)
    np.testing.assert_allclose(centre(picture.cell(1, 1)), colour(DEPTH_COLOURS, 1.0), atol=2)
    np.testing.assert_allclose(centre(picture.cell(1, 2)), centre(picture.cell(0, 2)), atol=2)
    np.testing.assert_allclose(centre(picture.cell(0, 3)), colour(ERROR_COLOURS, 0.0), atol=2)
    np.testing.assert_allclose(centre(picture.cell(1, 3)), colour(ERROR_COLOURS, 1.0), atol=2)


def test_near_is_red_and_far_is_blue() -> None:
    near, far = colour(DEPTH_COLOURS, 0.05), colour(DEPTH_COLOURS, 0.85)
    assert near[0] > near[2]
    assert far[2] > far[0]


def test_unmeasured_pixels_are_grey_in_truth_and_error_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = np.tile(np.linspace(1, 5, 32, dtype=np.float32), (24, 1))
    truth[8:16, 8:24] = 0
    picture = Picture(make_panel(truth), monkeypatch=monkeypatch)
    for column in (1, 3):
        assert np.abs(centre(picture.cell(0, column)) - GREY).max() <= 1
        share = (np.abs(picture.cell(0, column).astype(int) - GREY).max(axis=-1) <= 1).mean()
        assert share == pytest.approx(8 * 16 / (24 * 32), abs=0.02)
    for column in (0, 2):
        assert not (np.abs(picture.cell(0, column).astype(int) - GREY).max(axis=-1) <= 1).any()


@pytest.mark.parametrize("name", [DEPTH_COLOURS, ERROR_COLOURS])
def test_neither_scale_contains_the_grey(name: str) -> None:
    colours = colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255
    assert np.abs(colours - GREY).max(axis=1).min() > 30


def test_the_scale_is_in_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    picture = Picture(make_panel(), make_panel(), monkeypatch=monkeypatch)
    depth, error = picture.figure.axes[-2:]
    assert depth.get_xlabel() == "depth [m]"
    assert error.get_xlabel() == "absolute error [m]"
    assert depth.get_xlim() == pytest.approx((1, 5))
    assert [axis.get_title() for axis in picture.figure.axes[:4]] == ["image", "truth", "prediction", "absolute error"]


@pytest.mark.parametrize("shape", [(24, 32), (32, 24), (16, 64)])
@pytest.mark.parametrize("rows", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_nothing_is_cut_off_and_nothing_overlaps(
    monkeypatch: pytest.MonkeyPatch, rows: int, shape: tuple[int, int]
) -> None:
    panel = make_panel(height=shape[0], width=shape[1], title="a_very_long_folder/living_room_0029_out/rgb_000123")
    figure = Picture(*[panel] * rows, monkeypatch=monkeypatch).figure
    canvas: Any = figure.canvas
    boxes = [axis.get_tightbbox(canvas.get_renderer()) for axis in figure.axes]
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


def test_a_long_title_keeps_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    title = "x" * 100 + "/living_room_0029/123"
    picture = Picture(make_panel(title=title), make_panel(title="kitchen_0004/17"), monkeypatch=monkeypatch)
    long, short = (picture.figure.axes[4 * row].get_ylabel() for row in (0, 1))
    assert long.startswith("…")
    assert long.endswith("/living_room_0029/123")
    assert short == "kitchen_0004/17"


FLAT = np.full((24, 32), 3, np.float32)
NOTHING = np.zeros((24, 32), np.float32)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("truth", "pred"),
    [
        (FLAT, FLAT),
        (NOTHING, FLAT),
        (FLAT, NOTHING),
        (NOTHING, NOTHING),
        (FLAT, np.full_like(FLAT, np.nan)),
        (FLAT, np.full_like(FLAT, np.inf)),
        (FLAT, -FLAT),
        (np.full_like(FLAT, 0.01), FLAT),
    ],
    ids=["flat", "no truth", "prediction of 0", "nothing", "nan", "infinite", "negative", "near"],
)
def test_odd_depths(monkeypatch: pytest.MonkeyPatch, truth: F32, pred: F32) -> None:
    picture = Picture(make_panel(truth, pred), monkeypatch=monkeypatch)
    assert centre(picture.cell(0, 0)).tolist() == [10, 200, 30]
    if not truth.any():
        assert np.abs(picture.cell(0, 1) - GREY).max() <= 1
        assert np.abs(picture.cell(0, 3) - GREY).max() <= 1
    low, high = picture.figure.axes[-2].get_xlim()
    assert 0 <= low < high


def test_a_few_outliers_do_not_darken_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    pred = FLAT.copy() + 1
    pred[0, :3] = 1000
    picture = Picture(make_panel(FLAT, pred), monkeypatch=monkeypatch)
    assert picture.figure.axes[-1].get_xlim()[1] == pytest.approx(1.0)


def test_a_picture_is_written_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "images" / "epoch_001.png"
    save_panels(path, [make_panel()])
    before = path.read_bytes()
    written = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    assert np.array_equal(written, draw_panels([make_panel()]))

    def half(self: Figure, part: Path, **_: Any) -> None:
        part.write_bytes(before[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", half)
    with pytest.raises(OSError, match="No space left"):
        save_panels(path, [make_panel()] * 2)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["epoch_001.png"]


def test_real_frames(nyu_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (nyu_root / "index.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))[::700]
    panels = []
    for row in rows:
        image = cv2.cvtColor(cv2.imread(str(nyu_root / row["image"])), cv2.COLOR_BGR2RGB)
        value = cv2.imread(str(nyu_root / row["depth"]), cv2.IMREAD_UNCHANGED).astype(np.float32)
        truth = ((value + float(row["depth_offset"])) * float(row["depth_scale_m"])).astype(np.float32)
        panels.append(Panel(image, truth, cv2.GaussianBlur(truth, (0, 0), 9), title=f"{row['scene']}/{row['index']}"))
    picture = Picture(*panels, monkeypatch=monkeypatch)
    assert [picture.figure.axes[4 * i].get_ylabel() for i in range(len(rows))] == [panel.title for panel in panels]
    low, high = picture.figure.axes[-2].get_xlim()
    assert 0.4 < low < 2
    assert 3 < high < 11


@pytest.mark.parametrize("title", ["$a_{b$", "$\\\\nonsense$", "$x$"])
def test_dollar_signs_in_a_name_are_no_formula(tmp_path: Path, title: str) -> None:
    figure = Figure()
    figure.suptitle(title)
    axis = figure.subplots()
    axis.set_yticks([0.5], [title])
    axis.set_title(title, loc="left")
    save_figure(tmp_path / "figure.png", figure)
    assert {text.get_text() for text in figure.findobj(Text) if not text.get_parse_math()} >= {title}
    assert not [text for text in figure.findobj(Text) if text.get_text() == title and text.get_parse_math()]
    assert draw_panels([make_panel(title=title)]).size
