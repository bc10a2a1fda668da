from __future__ import annotations

from dataclasses import replace

import pytest

from experiments.ledger import rows_data
from experiments.ledger.units import Rooms, Score, predictions, render_rooms, score_readings


@pytest.fixture(scope="module")
def rooms() -> Rooms:
    return render_rooms(frames=4, side_px=48)


@pytest.fixture(scope="module")
def scores(rooms: Rooms) -> list[Score]:
    return score_readings(rooms, predictions(rooms))


@pytest.mark.slow
def test_split_counts_hold() -> None:
    row = rows_data.split_row()
    assert (row.verdict, row.values) == ("holds", {"train": 35_481, "val": 5_068, "test": 10_139})


@pytest.mark.slow
def test_split_counts_that_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.ledger.tables.SPLIT_COUNTS", (35_482, 5_068, 10_138))
    assert rows_data.split_row().verdict == "contradicted"


@pytest.mark.slow
def test_leakage() -> None:
    row = rows_data.leakage_row()
    assert row.verdict == "contradicted"
    assert row.values["within_1"]["expected"] == pytest.approx(0.91)
    assert row.values["within_1"]["counted"] == pytest.approx(0.91, abs=0.01)
    assert row.values["within_2"]["scene_split"] == 0


def test_ssim_and_loss_cannot_go_with_are(rooms: Rooms, scores: list[Score]) -> None:
    row = rows_data.ssim_and_loss_row(rooms, scores)
    assert row.verdict == "cannot be"
    bound = 0.0006 / (3 * 0.063) * 10
    assert row.values["largest_mean_depth_m"]["metres / 10"] == pytest.approx(bound)
    assert row.values["largest_mean_depth_m"]["8 bit read as millimetres"] == pytest.approx(bound / 0.0255)
    assert "below 3.2 cm" in row.measured
    assert row.sheets[0].cells[-1] == ["the paper", "proposed", "0.063", "0.237", "0.998", "0.0005 to 0.0006"]


def test_a_plausible_loss_is_judged_by_the_rooms(
    monkeypatch: pytest.MonkeyPatch, rooms: Rooms, scores: list[Score]
) -> None:
    monkeypatch.setattr("experiments.ledger.tables.LOSS_VAL", 0.01)  # a mean depth of 53 cm is possible
    assert rows_data.ssim_and_loss_row(rooms, scores).verdict == "contradicted"
    low = [replace(score, loss=0.005) for score in scores]
    assert rows_data.ssim_and_loss_row(rooms, low).verdict == "holds"


def test_rmse_is_in_metres(scores: list[Score]) -> None:
    row = rows_data.rmse_row(scores)
    assert row.verdict == "holds"
    assert (
        row.values["largest_rmse_m"]["8 bit read as millimetres"] < 0.237 < row.values["largest_rmse_m"]["metres / 10"]
    )
    assert row.measured.endswith("So RMSE is in true metres, whatever units the loss saw")


def test_an_rmse_beyond_the_bound_cannot_be(monkeypatch: pytest.MonkeyPatch, scores: list[Score]) -> None:
    from experiments.ledger import tables

    monkeypatch.setattr(tables, "PROPOSED", replace(tables.PROPOSED, rmse=2.0))
    assert rows_data.rmse_row(scores).verdict == "cannot be"


def test_eps_switches_the_term_off(rooms: Rooms) -> None:
    row = rows_data.eps_row(rooms, predictions(rooms)["smooth error"])
    assert row.verdict == "contradicted"
    assert row.values["1e-8"]["s"] == pytest.approx(1, abs=0.05)
    assert row.values["1e8"]["s"] < 1e-4
