from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hudepth.base.errors import DataError
from hudepth.report.curves import draw_curves
from hudepth.runs.history import read_history

TERMS = ("boundary", "scaling", "smoothness", "total")


def history(epochs: int, *, names: tuple[str, ...] = TERMS, val_every: int = 1) -> list[dict[str, float]]:
    rows = []
    for epoch in range(1, epochs + 1):
        row = {"epoch": float(epoch), "step": 10.0 * epoch, "val/abs_rel": 0.3}
        for factor, name in enumerate(names, start=1):
            row[f"train/loss/{name}"] = factor / epoch
            if epoch % val_every == 0:
                row[f"val/loss/{name}"] = 1.2 * factor / epoch
        rows.append(row)
    return rows


def lines(figure: Figure, axis: int) -> dict[str, tuple[list[float], list[float]]]:
    return {
        str(line.get_label()): (list(np.asarray(line.get_xdata())), list(np.asarray(line.get_ydata())))
        for line in figure.axes[axis].lines
    }


def test_a_plot_for_the_total_and_each_term() -> None:
    figure = draw_curves(history(5), title="badcl")
    titles = ["total loss", "boundary loss", "scaling loss", "smoothness loss"]
    assert [axis.get_title() for axis in figure.axes] == titles
    assert {axis.get_xlabel() for axis in figure.axes} == {"epoch"}
    assert figure.get_suptitle() == "badcl"
    legend = figure.axes[-1].get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["training", "validation"]
    epochs = [1, 2, 3, 4, 5]
    assert lines(figure, 0) == {
        "training": (epochs, [4 / e for e in epochs]),
        "validation": (epochs, [1.2 * 4 / e for e in epochs]),
    }


def test_epochs_without_validation_leave_the_line_whole() -> None:
    assert lines(draw_curves(history(6, val_every=3)), 0)["validation"][0] == [3, 6]
    assert set(lines(draw_curves(history(2, val_every=3)), 0)) == {"training"}


@pytest.mark.parametrize("epochs", [1, 2, 7, 100])
def test_epochs_are_whole_numbers(epochs: int) -> None:
    figure = draw_curves(history(epochs))
    for axis in figure.axes:
        low, high = axis.get_xlim()
        ticks = [tick for tick in axis.get_xticks() if low <= tick <= high]
        assert ticks
        assert all(tick == int(tick) for tick in ticks)
        assert low < 1 <= epochs < high


@pytest.mark.parametrize(("epochs", "names"), [(1, ("total",)), (30, ("total",)), (30, TERMS), (100, TERMS)])
def test_nothing_is_cut_off_and_no_plots_overlap(epochs: int, names: tuple[str, ...]) -> None:
    figure = draw_curves(history(epochs, names=names), title="badcl_official")
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = [axis.get_tightbbox(canvas.get_renderer()) for axis in figure.axes]
    right = 0.0
    for box in boxes:
        assert box is not None
        assert box.x0 >= right
        assert box.y0 >= 0
        assert box.y1 <= figure.bbox.height
        right = box.x1
    assert right <= figure.bbox.width


def test_losses_start_at_zero() -> None:
    assert {axis.get_ylim()[0] for axis in draw_curves(history(9)).axes} == {0}


def test_no_training_loss() -> None:
    with pytest.raises(DataError, match=r"train/loss/total"):
        draw_curves([{"epoch": 1.0, "val/abs_rel": 0.2}])


def test_history_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text(
        "epoch,step,train/loss/total,val/loss/total\n1,10,0.1,\n2,20,0.05,0.30000000000000004\n3,30,nan,inf\n"
    )
    first, second, third = read_history(path)
    assert first == {"epoch": 1, "step": 10, "train/loss/total": 0.1}
    assert second == {"epoch": 2, "step": 20, "train/loss/total": 0.05, "val/loss/total": 0.1 + 0.2}
    assert np.isnan(third["train/loss/total"])
    assert third["val/loss/total"] == float("inf")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (None, "No such file"),
        ("", "epoch"),
        ("epoch,train/loss/total\n", "epoch"),
        ("epoch\nmany\n", "'many'"),
        ("train/loss/total\n0.1\n", "without an epoch"),
    ],
)
def test_no_history(tmp_path: Path, content: str | None, why: str) -> None:
    path = tmp_path / "metrics.csv"
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=rf"metrics\.csv'.*{why}"):
        read_history(path)


@pytest.mark.parametrize("content", [b"epoch,train/loss/total\n1,0.1,7\n", b"\xff\xfe\x00", b"epoch\n1\x00\n"])
def test_damaged_history_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read_history(path)
    assert "\n" not in str(caught.value)


def test_a_metric_is_not_drawn_as_the_loss_of_its_name() -> None:
    rows = [
        {"epoch": e, "train/loss/total": 1.0, "val/loss/total": 1.0, "train/loss/silog": 2.0, "val/silog": 20.0}
        for e in (1.0, 2.0)
    ]
    total, silog = draw_curves(rows).axes
    assert len(total.lines) == 2
    assert [line.get_label() for line in silog.lines] == ["training"]
