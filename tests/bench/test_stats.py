from __future__ import annotations

import math
import statistics
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.bench.stats import gflop_per_s, images_per_s, summarise, times_as_fast

TIMES = st.floats(1e-5, 1e3)
ROUNDS: Any = st.lists(st.lists(TIMES, min_size=1, max_size=7), min_size=1, max_size=5)


def quantile(values: list[float], share: float) -> float:
    """By the definition: the value at place share (n - 1) of the sorted ones, straight lines in between."""
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    below = math.floor(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (place - below) * (ordered[above] - ordered[below])


@given(ROUNDS)
def test_quantiles_are_of_all_passes(rounds: list[list[float]]) -> None:
    timing = summarise(rounds)
    times = [1000 * time for own in rounds for time in own]
    assert timing.passes == len(times)
    found = (timing.p25_ms, timing.p50_ms, timing.p75_ms, timing.p95_ms)
    assert found == pytest.approx([quantile(times, share) for share in (0.25, 0.5, 0.75, 0.95)])
    assert timing.p50_ms == pytest.approx(statistics.median(times))
    assert list(found) == sorted(found)


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


def test_rates() -> None:
    assert images_per_s(32, 1600.0) == 20
    assert gflop_per_s(9_250_000_000, 20.0) == pytest.approx(185)
