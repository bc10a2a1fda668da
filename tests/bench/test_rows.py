from __future__ import annotations

import math
import statistics
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.bench.rounds import Sample
from hudepth.bench.rows import Entry, Row, describe_efficiency, make_rows, quantiles_ms, times_as_fast

TIMES = st.floats(1e-5, 1e3)
ROUNDS: Any = st.lists(st.lists(TIMES, min_size=1, max_size=7), min_size=1, max_size=5)


def sample(name: str, batch: int, pass_s: float, *, depth: float = 0.5) -> Sample:
    result = np.full((batch, 1, 2, 2), 0.5, np.float32)
    result[-1, 0, 1, 1] = depth
    return Sample(name, batch, 1.0, result, [[pass_s, pass_s], [pass_s]], 100.0)


def entry(name: str) -> Entry:
    return Entry(name, name, (224, 224), "", 1000, 2_000_000_000)


def rows_of(**passes_s: float) -> list[Row]:
    """Backends at batch 1, by the seconds of a pass."""
    samples = [sample(name, 1, pass_s) for name, pass_s in passes_s.items()]
    return make_rows(samples, [entry(name) for name in passes_s], peaks={"float32": 100.0}, max_depth_m=10.0)


def test_a_row_from_its_times() -> None:
    samples = [sample("eager", 4, 0.8), sample("openvino", 4, 0.2, depth=0.5001)]
    first, second = make_rows(samples, [entry("eager"), entry("openvino")], peaks={"float32": 100.0}, max_depth_m=10.0)
    assert (first.ms_per_image, first.images_per_s, first.p50_ms, first.passes) == pytest.approx((200, 5, 800, 3))
    assert (first.times_eager, first.difference_mm) == (1.0, 0.0)
    assert second.times_eager == pytest.approx(4)
    assert second.difference_mm == pytest.approx(1.0, rel=1e-3)
    assert second.gflop_per_s == pytest.approx(2 * 20)
    assert second.share_of_peak == pytest.approx(0.4)


@given(st.integers(1, 10**12), st.floats(1e-4, 1e2), st.integers(1, 64), st.floats(1, 1e5))
def test_share_of_peak(flops: int, pass_s: float, batch: int, peak: float) -> None:
    known = replace(entry("eager"), flops=flops)
    (row,) = make_rows([sample("eager", batch, pass_s)], [known], peaks={"float32": peak}, max_depth_m=10.0)
    assert row.share_of_peak == pytest.approx(flops * batch / pass_s / (peak * 1e9))


def test_rows_go_by_batch_then_by_entry() -> None:
    samples = [sample("b", 2, 1), sample("eager", 2, 1), sample("b", 1, 1), sample("eager", 1, 1)]
    rows = make_rows(samples, [entry("eager"), entry("b")], peaks={}, max_depth_m=10.0)
    assert [(row.batch, row.contender) for row in rows] == [(1, "eager"), (1, "b"), (2, "eager"), (2, "b")]
    assert rows[0].share_of_peak is None


def test_without_the_reference_there_is_nothing_to_compare_with() -> None:
    (row,) = make_rows([sample("openvino", 1, 1)], [entry("openvino")], peaks={}, max_depth_m=10.0)
    assert row.times_eager is None
    assert row.difference_mm is None
    assert not row.exact


def test_a_depth_that_is_no_number_is_not_exact() -> None:
    samples = [sample("eager", 1, 1), sample("b", 1, 1, depth=float("nan"))]
    rows = make_rows(samples, [entry("eager"), entry("b")], peaks={}, max_depth_m=10.0)
    assert [row.exact for row in rows] == [True, False]


def test_efficiency_is_of_the_fastest_exact_backend() -> None:
    rows = rows_of(eager=0.1, openvino=0.05, int8=0.01)
    rows[2] = replace(rows[2], difference_mm=30.0)
    line = describe_efficiency(rows, peak_gflop_per_s=100.0, merged_flops=1_500_000_000)
    assert line == (
        "Fastest exact backend at batch 1: openvino, 20.0 images/s, 40 nominal GFLOP/s, 40 % of the 100 GFLOP/s of a "
        "single-precision matrix product here; of the 1.50 GFLOP that remain when it is merged, 30 GFLOP/s or 30 %."
    )
    assert describe_efficiency(rows, peak_gflop_per_s=None, merged_flops=1) == ""
    assert "merged" not in describe_efficiency(rows[:1], peak_gflop_per_s=100.0, merged_flops=1_500_000_000)


def quantile(values: list[float], share: float) -> float:
    """By the definition: the value at place share (n - 1) of the sorted ones, straight lines in between."""
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    below = math.floor(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (place - below) * (ordered[above] - ordered[below])


def test_each_row_is_compared_with_the_product_of_its_precision() -> None:
    kinds = {"eager": "float32", "fp16": "float16", "elsewhere": None}
    entries = [replace(entry(name), yardstick=kind, precision=kind or "float32") for name, kind in kinds.items()]
    samples = [sample(name, 1, 0.1) for name in kinds]
    rows = make_rows(samples, entries, peaks={"float32": 100.0, "float16": 800.0}, max_depth_m=10.0)
    assert [row.share_of_peak for row in rows] == [pytest.approx(0.2), pytest.approx(0.025), None]
    assert [row.exact for row in rows] == [True, False, True]  # what is not float32 is exact by chance only


@given(ROUNDS)
def test_quantiles_are_of_all_passes(rounds: list[list[float]]) -> None:
    passes, *found = quantiles_ms(rounds)
    times = [1000 * time for own in rounds for time in own]
    assert passes == len(times)
    assert found == pytest.approx([quantile(times, share) for share in (0.25, 0.5, 0.75, 0.95)])
    assert found[1] == pytest.approx(statistics.median(times))
    assert found == sorted(found)


@given(ROUNDS, st.floats(0.1, 10))
def test_a_thing_is_as_many_times_as_fast_as_its_passes_are_shorter(rounds: list[list[float]], factor: float) -> None:
    slower = [[factor * time for time in own] for own in rounds]
    assert times_as_fast(rounds, slower) == pytest.approx(factor)
    assert times_as_fast(slower, rounds) == pytest.approx(1 / factor)


@given(st.lists(st.tuples(TIMES, st.floats(0.1, 10)), min_size=1, max_size=9))
def test_what_slows_both_in_a_round_does_not_count(slowed: list[tuple[float, float]]) -> None:
    reference = [[time * drift] for time, drift in slowed]
    own = [[time * drift / 3] for time, drift in slowed]
    assert times_as_fast(own, reference) == pytest.approx(3)


def test_one_bad_round_of_three_does_not_count() -> None:
    assert times_as_fast([[1.0], [1.0], [50.0]], [[2.0], [2.0], [2.0]]) == 2
