from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hudepth.report.ablation.heatmap import Grid, find_grid
from hudepth.report.ablation.report import Report
from tests.report.ablation.conftest import worked_out
from tests.report.ablation.synthetic import image_table, make_run


def grid(folder: Path, *weights: tuple[float, float, float], **more: Any) -> Grid | None:
    for number, (boundary, smoothness, scaling) in enumerate(weights):
        changes = {"loss.boundary": boundary, "loss.smoothness": smoothness, "loss.scaling": scaling, **more}
        make_run(folder / f"{number}", changes=changes, table=image_table(shift=number / 10))
    return find_grid(worked_out(folder).rows)


def test_two_weights_are_one_panel_and_other_losses_stay_out(report: Report) -> None:
    found = find_grid(report.rows)
    assert found is not None
    assert (found.y, found.x, found.panel) == ("smoothness", "scaling", "")
    assert (found.ys, found.xs, found.panels) == (["0", "1"], ["0", "1"], [""])
    assert {where[1:]: row.label for where, row in found.cells.items()} == {
        ("1", "1"): "paper", ("0", "1"): "no_smooth", ("1", "0"): "no_scale", ("0", "0"): "neither",
    }  # fmt: skip


def test_the_third_weight_makes_panels_and_values_are_sorted_as_numbers(tmp_path: Path) -> None:
    found = grid(tmp_path, (10, 0, 1), (9, 0.5, 1), (9, 0, 2), (10.0, 0.5, 2))
    assert found is not None
    assert (found.y, found.x, found.panel) == ("boundary", "smoothness", "scaling")
    assert (found.ys, found.xs, found.panels) == (["9", "10"], ["0", "0.5"], ["1", "2"])
    assert (
        found.cells["2", "9", "0"].estimates["rmse"].values["1"]
        > found.cells["1", "10", "0"].estimates["rmse"].values["1"]
    )
    assert ("2", "10", "0") not in found.cells


@pytest.mark.parametrize("weights", [[(1, 0, 0)], [(1, 0, 0), (2, 0, 0)]])
def test_one_weight_is_no_grid(tmp_path: Path, weights: list[tuple[float, float, float]]) -> None:
    assert grid(tmp_path, *weights) is None


def test_rows_that_differ_in_something_else_are_in_no_grid_with_the_others(tmp_path: Path) -> None:
    assert grid(tmp_path / "a", (1, 0, 0), (2, 1, 0)) is not None
    make_run(tmp_path / "b" / "x", changes={"loss.boundary": 1}, table=image_table())
    make_run(tmp_path / "b" / "y", changes={"loss.scaling": 2, "optim.lr": 1}, table=image_table())
    assert find_grid(worked_out(tmp_path / "b").rows) is None
