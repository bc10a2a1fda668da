from __future__ import annotations

from dataclasses import replace

from experiments.ledger import tables
from hudepth.bench.paper import RATES, describe_paper
from hudepth.bench.rows import Row, make_rows
from tests.bench.test_rows import entry, sample


def measured(*batches: int) -> list[Row]:
    samples = [
        sample(name, n, s * n) for n in batches for name, s in (("eager", 0.01), ("graph", 0.002), ("bf16", 0.001))
    ]
    entries = [entry("eager"), entry("graph"), replace(entry("bf16"), precision="bfloat16")]
    return make_rows(samples, entries, peaks={}, max_depth_m=10.0)


def test_the_rates_are_those_of_table_3() -> None:
    assert {row.batch: row.images_per_s for row in tables.TABLE_3} == RATES


def test_the_paper_is_beside_the_reference_and_the_fastest() -> None:
    rates = "eager 100 (float32), graph 500 (float32), bf16 1000 (bfloat16)."
    assert describe_paper(measured(1, 2, 8, 32), name="HybridUNet", gpu="H200") == [
        f"Images/s at batch 1: 249.84 on the paper's RTX 4090 (table 3); on this H200: {rates}",
        f"Images/s at batch 32: 1212.19 on the paper's RTX 4090 (table 3); on this H200: {rates}",
    ]
    assert len(describe_paper(measured(8), name="HybridUNet", gpu="H200")) == 1


def test_other_networks_sizes_and_batches_are_not_compared() -> None:
    assert describe_paper(measured(1), name="TinyUNet", gpu="H200") == []
    assert describe_paper(measured(2, 3), name="HybridUNet", gpu="H200") == []
    smaller = [replace(row, height=160, width=160) for row in measured(1)]
    assert describe_paper(smaller, name="HybridUNet", gpu="H200") == []
