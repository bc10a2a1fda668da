from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.bench.rounds import Sample
from hudepth.bench.rows import Entry, Row, comparisons, efficiency, make_rows, plain
from hudepth.bench.tables import csv_text, label, markdown, terminal_table

SIZE = (224, 224)


def sample(name: str, batch: int, pass_s: float, *, depth: float = 0.5) -> Sample:
    result = np.full((batch, 1, 2, 2), 0.5, np.float32)
    result[-1, 0, 1, 1] = depth
    return Sample(name, batch, 1.0, result, [[pass_s, pass_s], [pass_s]], 100.0)


def entry(name: str, *, peer: bool = False, size: tuple[int, int] = SIZE) -> Entry:
    own = f"{name}, {size[0]} x {size[1]}" if peer else name
    return Entry(own, name, size, peer, 1000, 2_000_000_000, "")


def rows_of(**passes_s: float) -> list[Row]:
    """Backends at batch 1, by the seconds of a pass."""
    samples = [sample(name, 1, pass_s) for name, pass_s in passes_s.items()]
    return make_rows(samples, [entry(name) for name in passes_s], peak_gflop_per_s=100.0, max_depth_m=10.0)


def peer_row(name: str, size: tuple[int, int], images_per_s: float) -> Row:
    row = replace(rows_of(eager=1 / images_per_s)[0], contender=name, kind="peer", height=size[0], width=size[1])
    return replace(row, difference_mm=None, times_eager=images_per_s / 10)


def test_a_row_from_its_times() -> None:
    samples = [sample("eager", 4, 0.8), sample("openvino", 4, 0.2, depth=0.5001)]
    first, second = make_rows(samples, [entry("eager"), entry("openvino")], peak_gflop_per_s=100.0, max_depth_m=10.0)
    assert (first.ms_per_image, first.images_per_s, first.p50_ms, first.passes) == pytest.approx((200, 5, 800, 3))
    assert (first.times_eager, first.difference_mm) == (1.0, 0.0)
    assert second.times_eager == pytest.approx(4)
    assert second.difference_mm == pytest.approx(1.0, rel=1e-3)
    assert second.gflop_per_s == pytest.approx(2 * 20)
    assert second.share_of_peak == pytest.approx(0.4)


@given(st.integers(1, 10**12), st.floats(1e-4, 1e2), st.integers(1, 64), st.floats(1, 1e5))
def test_share_of_peak(flops: int, pass_s: float, batch: int, peak: float) -> None:
    known = replace(entry("eager"), flops=flops)
    (row,) = make_rows([sample("eager", batch, pass_s)], [known], peak_gflop_per_s=peak, max_depth_m=10.0)
    assert row.share_of_peak == pytest.approx(flops * batch / pass_s / (peak * 1e9))


def test_rows_go_by_batch_then_by_entry() -> None:
    samples = [sample("b", 2, 1), sample("eager", 2, 1), sample("b", 1, 1), sample("eager", 1, 1)]
    rows = make_rows(samples, [entry("eager"), entry("b")], peak_gflop_per_s=None, max_depth_m=10.0)
    assert [(row.batch, row.contender) for row in rows] == [(1, "eager"), (1, "b"), (2, "eager"), (2, "b")]
    assert rows[0].share_of_peak is None


def test_without_the_reference_there_is_nothing_to_compare_with() -> None:
    (row,) = make_rows([sample("openvino", 1, 1)], [entry("openvino")], peak_gflop_per_s=None, max_depth_m=10.0)
    assert row.times_eager is None
    assert row.difference_mm is None
    assert not row.exact


def test_a_depth_that_is_no_number_is_not_exact() -> None:
    samples = [sample("eager", 1, 1), sample("b", 1, 1, depth=float("nan"))]
    rows = make_rows(samples, [entry("eager"), entry("b")], peak_gflop_per_s=None, max_depth_m=10.0)
    assert [row.exact for row in rows] == [True, False]


def test_efficiency_is_of_the_fastest_exact_backend() -> None:
    rows = rows_of(eager=0.1, openvino=0.05, int8=0.01)
    rows[2] = replace(rows[2], difference_mm=30.0)
    line = efficiency(rows, peak_gflop_per_s=100.0, merged_flops=1_500_000_000)
    assert line == (
        "Fastest exact backend at batch 1: openvino, 20.0 images/s, 40 nominal GFLOP/s, 40 % of the 100 GFLOP/s of a "
        "single-precision matrix product here; of the 1.50 GFLOP that are left when it is merged, 30 GFLOP/s or 30 %."
    )
    assert efficiency(rows, peak_gflop_per_s=None, merged_flops=1) == ""
    assert "merged" not in efficiency(rows[:1], peak_gflop_per_s=100.0, merged_flops=1_500_000_000)


def test_peers_are_put_beside_this_model_in_words() -> None:
    rows = rows_of(eager=0.1, default=0.08, openvino=0.04)  # 10, 12.5 and 25 images/s
    rows += [peer_row("Small", SIZE, 11.0), peer_row("Small", (480, 640), 1.0), peer_row("Large", (384, 384), 5.0)]
    assert comparisons(rows, size=SIZE) == [
        "Images/s at batch 1 over those of this model at 224:",
        "Small (random weights, eager): at 224 1.10 x eager and 0.88 x default; at 480 x 640 0.10 x eager and 0.08 x "
        "default.",
        "Large (random weights, eager): at 384 0.50 x eager and 0.40 x default.",
        "Of the peers, at the size nearest to this model's: Small is faster than eager; none is faster than default; "
        "none is faster than openvino.",
    ]
    assert comparisons(rows[:3], size=SIZE) == []


def test_tables_say_what_the_rows_say() -> None:
    rows = [*rows_of(eager=0.1, default=0.08), peer_row("Small", (480, 640), 1234.5)]
    assert [label(row) for row in rows] == ["eager", "default", "Small, 480 x 640"]
    assert label(peer_row("Small", (518, 518), 1.0)) == "Small, 518"
    read = list(csv.DictReader(io.StringIO(csv_text(rows))))
    for text, row in zip(read, rows, strict=True):
        assert text == {key: "" if value is None else str(value) for key, value in plain(row).items()}
    machine = {
        "processor": "P", "cores": 4, "usable_cores": 2, "memory_gb": 8.2, "instruction_sets": ["avx2"],
        "system": "Linux", "python": "3.11", "packages": {"torch": "2.6", "openvino": None},
    }  # fmt: skip
    page = markdown(rows, title="T", machine=machine, sentences=["A."], notes=["n"])
    assert "On P, 4 cores of which 2 may be used, 8 GB, avx2; Linux, Python 3.11, torch 2.6." in page
    table = [line for line in page.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in table}) == 1
    assert "| 1 | Small, 480 x 640 | 0.81 | 1234 |" in page
    assert page.endswith("- A.\n- n\n")
    assert terminal_table(rows, title="T").row_count == 3
