from __future__ import annotations

from experiments.ledger import tables


def test_table_a1_adds_up_to_the_stated_total() -> None:
    assert sum(row.parameters or 0 for row in tables.TABLE_A1) == tables.PARAMETERS == 4_653_313
    assert {row.shape[0] for row in tables.TABLE_A1} == {tables.TABLE_A1_BATCH}


def test_split_and_flops_agree_with_themselves() -> None:
    assert sum(tables.SPLIT_COUNTS) == tables.FRAMES
    assert 2 * tables.MULT_ADDS_G == tables.GFLOPS


def test_metrics_of_a_row_come_in_the_order_of_the_columns() -> None:
    assert list(tables.PROPOSED.metrics().items()) == [
        ("abs_rel", 0.063), ("rmse", 0.237), ("log10", 0.026), ("delta1", 0.982), ("delta2", 0.996), ("delta3", 0.998),
    ]  # fmt: skip
    assert tables.PROPOSED.deltas == (0.982, 0.996, 0.998)
