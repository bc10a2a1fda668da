from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from hudepth.metrics.bootstrap import Draws, Resampler, interval_of, intervals, paired_differences
from hudepth.metrics.summary import ImageTable, summarise
from hudepth.report.ablation.estimates import Interval, contrast, estimate, over_seeds, verdict
from tests.report.ablation.synthetic import image_table

NUMBERS = st.floats(-10, 10).map(lambda x: round(x, 6))


def drawn(tables: dict[str, ImageTable], *, repeats: int = 2000) -> dict[str, Draws]:
    sampler = Resampler(next(iter(tables.values())), repeats=repeats)
    return {seed: sampler.draws(table, averaging="image") for seed, table in tables.items()}


def values(tables: dict[str, ImageTable], name: str) -> dict[str, float]:
    return {seed: summarise(table, averaging="image")[name] for seed, table in tables.items()}


@given(st.lists(NUMBERS, min_size=2, max_size=6))
def test_the_interval_over_seeds_is_that_of_scipy(x: list[float]) -> None:
    got = over_seeds(x)
    if np.ptp(x) == 0:
        assert got.low == pytest.approx(x[0], abs=1e-12)
        assert got.high == pytest.approx(x[0], abs=1e-12)
    else:
        expected = scipy.stats.t.interval(0.95, len(x) - 1, loc=np.mean(x), scale=scipy.stats.sem(x))
        assert (got.low, got.high) == pytest.approx(expected, rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("x", [[], [0.3], [0.3, math.nan], [0.3, math.inf, 0.2]])
def test_too_few_seeds_have_no_interval(x: list[float]) -> None:
    assert not over_seeds(x).known


def test_the_interval_over_scenes_is_the_bootstrap_of_the_mean_over_seeds() -> None:
    tables = {str(seed): image_table(seed=seed) for seed in (1, 2, 3)}
    got = estimate("rmse", values(tables, "rmse"), drawn(tables))
    joint = image_table()
    joint.values["rmse"] = np.mean([table.values["rmse"] for table in tables.values()], axis=0)
    expected = intervals(joint, averaging="image")["rmse"]  # the mean of metrics is the metric of mean images
    assert (got.scenes.low, got.scenes.high) == pytest.approx(expected, rel=1e-9)
    assert got.mean == pytest.approx(joint.values["rmse"].mean())


def test_one_seed_differs_as_a_comparison_of_two_runs_says() -> None:
    a, b = image_table(seed=1), image_table(seed=2, shift=0.01)
    got = contrast(
        "abs_rel", values({"1": b}, "abs_rel"), values({"1": a}, "abs_rel"), drawn({"1": b}), drawn({"1": a})
    )
    expected = paired_differences(a, b, averaging="image")["abs_rel"]
    assert got is not None
    assert (got.value, got.scenes.low, got.scenes.high) == pytest.approx((expected.value, expected.low, expected.high))
    assert not got.seeds.known
    assert got.paired == ["1"]


def test_a_difference_is_paired_by_the_seeds_that_both_have() -> None:
    reference = {str(seed): image_table(seed=seed) for seed in (1, 2, 3)}
    row = {str(seed): image_table(seed=10 + seed, shift=0.02) for seed in (2, 3, 4)}
    got = contrast("rmse", values(row, "rmse"), values(reference, "rmse"), drawn(row), drawn(reference))
    assert got is not None
    assert got.paired == ["2", "3"]
    steps = np.array([values(row, "rmse")[s] - values(reference, "rmse")[s] for s in got.paired])
    expected = scipy.stats.t.interval(0.95, 1, loc=steps.mean(), scale=scipy.stats.sem(steps))
    assert (got.seeds.low, got.seeds.high) == pytest.approx(expected)
    assert got.value == pytest.approx(steps.mean())
    rng = np.random.default_rng(0)  # scenes by hand
    per_image = np.mean([row[s].values["rmse"] - reference[s].values["rmse"] for s in got.paired], axis=0)
    per_scene = per_image.reshape(3, 8).sum(axis=0)
    counts = rng.multinomial(8, np.full(8, 1 / 8), size=2000)
    assert (got.scenes.low, got.scenes.high) == pytest.approx(interval_of(counts @ per_scene / 24, 8))


def test_no_seed_in_common_is_no_difference() -> None:
    assert contrast("rmse", {"1": 0.2}, {"2": 0.3}, {}, {}) is None


@given(seed=st.integers(0, 50))
def test_identical_rows_do_not_differ(seed: int) -> None:
    tables = {str(s): image_table(seed=seed + s) for s in (1, 2)}
    x, draws = values(tables, "rmse"), drawn(tables, repeats=100)
    got = contrast("rmse", x, dict(x), draws, draws)
    assert got is not None
    assert (got.value, got.seeds, got.scenes) == (0, Interval(0, 0), Interval(0, 0))
    assert got.verdict == "not shown"


@given(shift=st.floats(-0.05, 0.05).filter(lambda x: abs(x) > 1e-4))
def test_a_shift_of_all_images_is_the_difference(shift: float) -> None:
    tables = {str(s): image_table(seed=s) for s in (1, 2)}
    moved = {str(s): image_table(seed=s, shift=shift) for s in (1, 2)}
    got = contrast(
        "rmse", values(moved, "rmse"), values(tables, "rmse"), drawn(moved, repeats=100), drawn(tables, repeats=100)
    )
    assert got is not None
    found = (got.value, got.seeds.low, got.seeds.high, got.scenes.low, got.scenes.high)
    assert found == pytest.approx([shift] * 5, abs=1e-9)
    assert got.verdict == ("worse" if shift > 0 else "better")


@pytest.mark.parametrize(
    ("seeds", "scenes", "word"),
    [
        ((0.1, 0.2), (0.1, 0.2), "worse"),
        ((-0.1, 0.2), (0.1, 0.2), "not shown"),
        ((0.1, 0.2), (-0.1, 0.2), "not shown"),
        ((0.1, 0.2), (0.0, 0.2), "not shown"),
        ((math.nan, math.nan), (0.1, 0.2), "worse"),
        ((0.1, 0.2), (math.nan, math.nan), "worse"),
        ((math.nan, math.nan), (math.nan, math.nan), "not shown"),
    ],
)
def test_the_verdict_needs_every_interval_there_is(
    seeds: tuple[float, float], scenes: tuple[float, float], word: str
) -> None:
    assert verdict("rmse", 0.15, Interval(*seeds), Interval(*scenes)) == word
    opposite = {"worse": "better"}.get(word, word)
    assert verdict("delta1", 0.15, Interval(*seeds), Interval(*scenes)) == opposite


def test_an_undefined_seed_leaves_no_mean() -> None:
    got = estimate("rmse", {"1": 0.3, "2": math.nan}, {})
    assert math.isnan(got.mean)
    assert not got.seeds.known
    assert not got.scenes.known
