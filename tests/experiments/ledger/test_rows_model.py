from __future__ import annotations

import pytest

from experiments.ledger import rows_model
from experiments.ledger.speed import Speed
from experiments.ledger.tables import TABLE_3


def test_rows_that_hold() -> None:
    assert rows_model.parameters_row().verdict == "holds"
    row = rows_model.table_a1_row()
    assert (row.verdict, row.values["matching"]) == ("holds", 43)
    assert len(row.sheets[0].cells) == 43
    assert all(len(cells) == len(row.sheets[0].header) for cells in row.sheets[0].cells)
    assert rows_model.table_3_row().verdict == "holds"


def test_a_network_with_other_parameters_is_contradicted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.ledger.tables.PARAMETERS", 4_653_314)
    assert rows_model.parameters_row().verdict == "contradicted"
    assert rows_model.table_a1_row().verdict == "contradicted"


def test_the_text_is_contradicted_by_its_parameters() -> None:
    row = rows_model.text_row()
    assert row.verdict == "contradicted"
    assert "23,786,048" in row.measured
    assert row.values["sum_of_table_a1"] == 4_653_313


def test_cost_and_its_overstatement() -> None:
    row = rows_model.cost_row()
    assert row.verdict == "contradicted"
    assert row.values["flops_pytorch"] == row.values["flops_by_hand"] == 9_250_848_768
    assert row.values["stated_over_counted"] == pytest.approx(86.04 / 9.250848768)
    assert "9.25 GFLOPs by PyTorch's counter" in row.measured
    assert "9.3 times too high" in row.measured
    assert "104 TFLOP/s" in row.measured  # 86.04 G x 1212.19


def test_cost_would_hold_at_what_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.ledger.tables.GFLOPS", 9.25)
    assert rows_model.cost_row().verdict == "holds"


def test_the_stated_figure_is_that_of_a_batch() -> None:
    row = rows_model.torchinfo_row()
    assert row.verdict == "holds"
    assert sum(row.values["by_kind"].values()) == row.values["mult_adds_of_batch"] == 43_022_202_880


def test_speed_can_be_left_out() -> None:
    row = rows_model.speed_row(batches=[], seconds=1, device_name="x")
    assert (row.verdict, row.measured) == ("not measured", "not measured: left out by --no-throughput")


@pytest.mark.parametrize(
    ("device", "factor", "verdict"),
    [
        ("NVIDIA GeForce RTX 4090", 1.0, "holds"),
        ("NVIDIA GeForce RTX 4090", 0.5, "contradicted"),
        ("CPU", 1.0, "another device"),
    ],
)
def test_speed_is_judged_on_the_papers_card_only(
    monkeypatch: pytest.MonkeyPatch, device: str, factor: float, verdict: str
) -> None:
    ms = {row.batch: row.ms_per_image for row in TABLE_3}
    monkeypatch.setattr(
        rows_model, "measure_speed", lambda _n, *, batch, **_: Speed(batch, ms.get(batch, 1.0) / factor, 3)
    )
    row = rows_model.speed_row(batches=[1, 2, 32], seconds=1, device_name=device)
    assert row.verdict == verdict
    assert [cells[4] for cells in row.sheets[0].cells] == ["249.84", "", "1212.19"]
    assert row.values["speeds"][0]["images_per_s"] == pytest.approx(factor * 1000 / 4.003)
