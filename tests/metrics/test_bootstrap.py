from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.metrics.bootstrap import (
    LEVEL,
    bootstrap,
    describe,
    intervals,
    paired_differences,
    unpaired_differences,
)
from hudepth.metrics.summary import ImageTable, summarise

NAMES = ("abs_rel", "rmse", "rmse_log", "log_bias", "silog", "ssim")


def make_table(
    seed: int = 0, *, scenes: int = 6, names: tuple[str, ...] = NAMES, holes: bool = True, start: int = 0
) -> ImageTable:
    """Return 1 to 5 images of each scene; with ``holes``, one has no pixel and one no ssim."""
    rng = np.random.default_rng(seed)
    scene = np.repeat(np.arange(scenes), rng.integers(1, 6, scenes))
    scene = rng.permutation(np.concatenate([scene, scene[:1]]))
    values = {name: rng.uniform(0.1, 0.9, len(scene)) for name in names}
    if "log_bias" in values:
        values["log_bias"] = 0.5 * values["rmse_log"]
    pixels = rng.integers(50, 100, len(scene))
    if holes:
        pixels[0] = 0
        for column in values.values():
            column[0] = math.nan
        values["ssim"][1] = math.nan
    return ImageTable(
        ids=[f"{i + start:03d}" for i in range(len(scene))],
        scenes=[f"room_{s}" for s in scene],
        categories=["room"] * len(scene),
        pixels=pixels,
        values=values,
    )


def take(table: ImageTable, rows: list[int]) -> ImageTable:
    return ImageTable(
        ids=[table.ids[i] for i in rows],
        scenes=[table.scenes[i] for i in rows],
        categories=[table.categories[i] for i in rows],
        pixels=table.pixels[rows],
        values={name: values[rows] for name, values in table.values.items()},
    )


def oracle(table: ImageTable, *, repeats: int, seed: int, **options: Any) -> dict[str, list[float]]:
    """Draw scenes, put their images together, and take the metrics of those."""
    rng = np.random.default_rng(seed)
    counted = [i for i, n in enumerate(table.pixels) if n > 0]
    names = list(dict.fromkeys(table.scenes[i] for i in counted))
    drawn: dict[str, list[float]] = {}
    for _ in range(repeats):
        times = rng.multinomial(len(names), [1 / len(names)] * len(names))
        chosen = [name for name, count in zip(names, times, strict=True) for _ in range(count)]
        rows = [i for name in chosen for i in counted if table.scenes[i] == name]
        for name, value in summarise(take(table, rows), **options).items():
            drawn.setdefault(name, []).append(value)
    return drawn


@pytest.mark.parametrize("averaging", ["image", "pooled"])
@given(seed=st.integers(0, 1000))
def test_draws_are_the_metrics_of_resampled_scenes(averaging: str, seed: int) -> None:
    table = make_table(seed)
    options: dict[str, Any] = {"averaging": averaging, "silog_lambda": 0.85, "silog_factor": 10.0}
    expected = oracle(table, repeats=20, seed=seed, **options)
    got = bootstrap(table, repeats=20, seed=seed, **options)
    assert list(got) == list(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(got[name], values, rtol=1e-12)


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_the_interval_holds_the_value_and_grows_with_the_scatter_of_scenes(averaging: str) -> None:
    table = make_table(scenes=30)
    value, between = summarise(table, averaging=averaging), intervals(table, averaging=averaging)
    assert list(between) == list(value)
    assert all(low < value[name] < high for name, (low, high) in between.items())
    centred = {name: np.nanmean(column) + 0.1 * (column - np.nanmean(column)) for name, column in table.values.items()}
    low, high = intervals(replace(table, values=centred), averaging=averaging)["abs_rel"]
    assert high - low == pytest.approx(0.1 * (between["abs_rel"][1] - between["abs_rel"][0]))


def test_draws_are_repeatable_and_seeded() -> None:
    table = make_table(scenes=20)
    first = intervals(table, averaging="image", repeats=200)
    assert intervals(table, averaging="image", repeats=200) == first
    assert intervals(table, averaging="image", repeats=200, seed=1)["abs_rel"] != first["abs_rel"]


def test_draws_are_the_same_however_many_are_made_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    table = make_table(scenes=7)
    whole = bootstrap(table, averaging="image", repeats=50)
    monkeypatch.setattr("hudepth.metrics.bootstrap.MOST_COUNTS", 100)  # 4 parts
    parts = bootstrap(table, averaging="image", repeats=50)
    for name, values in whole.items():
        np.testing.assert_allclose(parts[name], values, rtol=1e-12)


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_one_scene_has_no_interval(averaging: str) -> None:
    table = make_table(scenes=1, holes=False)
    between = intervals(table, averaging=averaging, repeats=50)
    assert all(math.isnan(low) and math.isnan(high) for low, high in between.values())
    difference = paired_differences(table, table, averaging=averaging, repeats=50)["abs_rel"]
    assert difference.value == 0
    assert math.isnan(difference.low)


def test_a_metric_that_one_scene_defines_has_no_interval() -> None:
    table = make_table(scenes=12)
    only = np.array([scene == "room_3" for scene in table.scenes]) & (table.pixels > 0)
    table.values["ssim"][~only] = math.nan
    between = intervals(table, averaging="image")
    assert math.isnan(between["ssim"][0])
    assert math.isfinite(between["abs_rel"][0])


def test_draws_without_an_image_that_defines_a_metric_are_left_out() -> None:
    table = make_table(scenes=10, holes=False)
    five = np.isin(table.scenes, [f"room_{i}" for i in range(5)])
    table.values["ssim"][~five] = math.nan
    drawn = bootstrap(table, averaging="image", repeats=20_000)["ssim"]
    assert 0 < np.isnan(drawn).sum() < len(drawn)  # (5/10)^10 of them
    low, high = intervals(table, averaging="image")["ssim"]
    assert low < summarise(table, averaging="image")["ssim"] < high


@pytest.mark.parametrize("averaging", ["image", "pooled"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_prediction_of_nan_is_not_hidden(averaging: str, bad: float) -> None:
    table = make_table(scenes=10)
    table.values["abs_rel"][2] = bad
    low, high = intervals(table, averaging=averaging)["abs_rel"]
    assert math.isnan(low)
    assert math.isnan(high)
    assert math.isfinite(intervals(table, averaging=averaging)["rmse"][0])


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_no_pixel_anywhere_is_nan(averaging: str) -> None:
    table = make_table()
    empty = replace(table, pixels=np.zeros_like(table.pixels))
    between = intervals(empty, averaging=averaging, repeats=10)
    assert set(between) == set(summarise(empty, averaging=averaging))
    assert all(math.isnan(low) for low, _ in between.values())
    assert describe(empty)["scenes"] == 0


def test_images_without_a_scene_are_scenes_of_their_own() -> None:
    table = make_table(scenes=8)
    nameless = replace(table, scenes=[""] * len(table.ids))
    numbered = replace(table, scenes=table.ids)
    assert intervals(nameless, averaging="image") == intervals(numbered, averaging="image")
    assert describe(nameless)["scenes"] == len(table.ids) - 1  # one has no pixel


def test_stamp() -> None:
    assert describe(make_table(scenes=7), repeats=500, seed=3) == {
        "method": "expanded percentile bootstrap by scene",
        "level": 0.95,
        "repeats": 500,
        "seed": 3,
        "scenes": 7,
    }


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_paired_differences_use_the_same_draws(averaging: str) -> None:
    a = make_table(scenes=15, names=("abs_rel", "rmse", "ssim"))
    noise = np.random.default_rng(1).normal(0.02, 0.005, len(a.ids))
    b = replace(a, values={**{name: column + noise for name, column in a.values.items()}, "edge_f1_0.25": noise})
    differences = paired_differences(a, b, averaging=averaging)
    assert list(differences) == ["abs_rel", "rmse", "ssim", "rmse_pooled"]  # what only one has is no difference
    before, after = summarise(a, averaging=averaging), summarise(b, averaging=averaging)
    drawn = bootstrap(b, averaging=averaging)["abs_rel"] - bootstrap(a, averaging=averaging)["abs_rel"]
    for name, difference in differences.items():
        assert difference.value == after[name] - before[name]
        assert difference.low < difference.value < difference.high
    assert drawn.min() <= differences["abs_rel"].low < np.percentile(drawn, 2.5)
    apart = unpaired_differences(a, b, averaging=averaging)["abs_rel"]
    assert apart.value == differences["abs_rel"].value
    assert apart.high - apart.low > 5 * (differences["abs_rel"].high - differences["abs_rel"].low)


def test_equal_results_differ_by_nothing() -> None:
    table = make_table(scenes=9)
    for difference in paired_differences(table, table, averaging="pooled").values():
        assert (difference.value, difference.low, difference.high) == (0, 0, 0)


def test_unpaired_differences_add_both_variances() -> None:
    a, b = make_table(1, scenes=60), make_table(2, scenes=60, start=500)
    half = {
        side: np.subtract(*reversed(intervals(table, averaging="image", repeats=8000)["abs_rel"])) / 2
        for side, table in (("a", a), ("b", b))
    }
    difference = unpaired_differences(a, b, averaging="image", repeats=8000)["abs_rel"]
    assert (difference.high - difference.low) / 2 == pytest.approx(math.hypot(half["a"], half["b"]), rel=0.04)


@pytest.mark.parametrize("what", ["order", "scenes", "pixels", "count"])
def test_only_the_same_images_are_paired(what: str) -> None:
    a = make_table(scenes=4)
    b = {
        "order": take(a, list(range(len(a.ids)))[::-1]),
        "scenes": replace(a, scenes=a.scenes[1:] + a.scenes[:1]),
        "pixels": replace(a, pixels=a.pixels + 1),
        "count": take(a, [0, 1]),
    }[what]
    with pytest.raises(DataError) as caught:
        paired_differences(a, b, averaging="image")
    assert str(caught.value) == (
        f"no paired comparison: the {len(a.ids)} and {len(b.ids)} rows are not of the same images, scenes and pixels "
        "in the same order. Compare them as different images."
    )


def simulated(rng: np.random.Generator, scenes: int) -> ImageTable:
    """Return five images a scene on average; half of the variance is the scene's. The true mean is 1."""
    sizes = 1 + rng.poisson(4, scenes)
    scene = np.repeat(np.arange(scenes), sizes)
    values = 1 + 0.1 * rng.standard_normal(scenes)[scene] + 0.1 * rng.standard_normal(len(scene))
    n = len(scene)
    return ImageTable(
        ids=[str(i) for i in range(n)],
        scenes=[str(s) for s in scene],
        categories=[""] * n,
        pixels=np.full(n, 1000),
        values={"abs_rel": values},
    )


def coverage(scenes: int, *, sets: int, repeats: int, seed: int = 0) -> dict[str, float]:
    """Return the share of simulated sets whose interval holds the true mean, for three kinds of interval."""
    rng = np.random.default_rng(seed)
    held: dict[str, list[bool]] = {"expanded": [], "plain": [], "by image": []}

    def note(kind: str, between: NDArray[np.float64] | tuple[float, float]) -> None:
        held[kind].append(bool(between[0] <= 1 <= between[1]))

    for number in range(sets):
        table = simulated(rng, scenes)
        options: dict[str, Any] = {"averaging": "image", "repeats": repeats, "seed": number}
        note("expanded", intervals(table, **options)["abs_rel"])
        note("plain", np.percentile(bootstrap(table, **options)["abs_rel"], [2.5, 97.5]))
        note("by image", intervals(replace(table, scenes=[""] * len(table.ids)), **options)["abs_rel"])
    return {kind: float(np.mean(each)) for kind, each in held.items()}


def test_coverage_is_what_it_says() -> None:
    assert LEVEL == 0.95
    share = coverage(40, sets=250, repeats=400)
    assert 0.90 <= share["expanded"] <= 0.98
    assert share["by image"] < 0.85


def test_few_scenes_need_the_wider_percentiles() -> None:
    share = coverage(8, sets=250, repeats=1000)
    assert 0.90 <= share["expanded"] <= 0.98
    assert share["plain"] < share["expanded"] - 0.03


@pytest.mark.parametrize(("scenes", "known"), [(1, False), (4, False), (5, True)])
def test_a_few_scenes_give_no_interval(scenes: int, known: bool) -> None:
    table = make_table(scenes=scenes, holes=False)
    low, high = intervals(table, averaging="image")["rmse"]
    assert math.isfinite(low) == math.isfinite(high) == known
