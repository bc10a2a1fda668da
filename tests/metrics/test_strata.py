from __future__ import annotations

import csv
import io
import math
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from hudepth.metrics.depth import depth_sums
from hudepth.metrics.strata import (
    STRATA,
    STRATUM_SUMS,
    Stratum,
    edge_distance_px,
    strata_csv,
    strata_sums,
    summarise_strata,
)

GROUPS = ("depth", "edge distance", "region")
SEEDS = st.integers(0, 1000)
UPPER = {"depth": (1, 2, 3, 4, 6, 8, math.inf), "edge distance": (2, 5, 10, 20, 40, math.inf)}


def make_case(seed: int = 0, *, batch: int = 2, height: int = 30, width: int = 70) -> tuple[Tensor, Tensor, Tensor]:
    """Tilted walls of 0.5 to 10 m with one box before each, so that every distance to an edge occurs."""
    rng = np.random.default_rng(seed)
    target = np.empty((batch, 1, height, width))
    for image in target[:, 0]:
        image[:] = np.geomspace(rng.uniform(0.5, 2), rng.uniform(5, 10), width)
        top, left = rng.integers(0, height - 4), rng.integers(0, width // 4)
        image[top : top + 4, left : left + 5] *= rng.uniform(0.5, 0.85)
    pred = target * rng.lognormal(0, 0.25, target.shape)
    valid = rng.random(target.shape) > 0.1
    return torch.tensor(pred).float(), torch.tensor(target).float(), torch.tensor(valid)


def oracle_edges(depth: NDArray[Any], valid: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixel by pixel, neighbour by neighbour."""
    edges = np.zeros(depth.shape, bool)
    for y, x in np.argwhere(valid):
        for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            if 0 <= v < depth.shape[0] and 0 <= u < depth.shape[1] and valid[v, u]:
                pair = sorted((depth[y, x], depth[v, u]))
                edges[y, x] |= pair[1] / pair[0] > 1.1
    return edges


def oracle_distances(depth: NDArray[Any], valid: NDArray[Any]) -> NDArray[np.float64]:
    edges = oracle_edges(depth, valid)
    return np.asarray(ndimage.distance_transform_edt(~edges)) if edges.any() else np.full(depth.shape, np.inf)


def oracle_sums(pred: NDArray[Any], depth: NDArray[Any], valid: NDArray[Any]) -> NDArray[np.float64]:
    sums = {stratum: np.zeros(5) for stratum in STRATA}
    names = {group: [label for g, label in STRATA if g == group] for group in GROUPS}
    distances = oracle_distances(depth, valid)
    sides = ("top", "middle", "bottom"), ("left", "centre", "right")
    for y, x in np.argwhere(valid):
        p, t = pred[y, x], depth[y, x]
        row = [1, abs(p - t) / t, (p - t) ** 2, abs(p - t), max(max(p, 1e-3) / t, t / max(p, 1e-3)) < 1.25]
        for group, value in (("depth", t), ("edge distance", distances[y, x])):
            bin_ = next(i for i, upper in enumerate(UPPER[group]) if value < upper or upper == math.inf)
            sums[group, names[group][bin_]] += row
        third = sides[0][3 * y // depth.shape[0]], sides[1][3 * x // depth.shape[1]]
        sums["region", " ".join(third)] += row
    return np.stack(list(sums.values()))


def by_group(sums: Tensor) -> dict[str, Tensor]:
    """Sum over the bins of each group."""
    return {group: sums[:, [i for i, (g, _) in enumerate(STRATA) if g == group]].sum(dim=1) for group in GROUPS}


def stratum(pred: Tensor, target: Tensor, valid: Tensor, group: str) -> dict[str, list[float]]:
    """Columns of the bins of one group of one image that hold a pixel."""
    (sums,) = strata_sums(pred, target, valid)
    return {label: row.tolist() for (g, label), row in zip(STRATA, sums, strict=True) if g == group and row[0]}


def test_the_bins() -> None:
    assert len(STRATA) == len(set(STRATA)) == 7 + 6 + 9
    assert [label for group, label in STRATA if group == "depth"] == [
        "0-1 m", "1-2 m", "2-3 m", "3-4 m", "4-6 m", "6-8 m", "8 m and more",
    ]  # fmt: skip
    assert [label for group, label in STRATA if group == "edge distance"] == [
        "0-2 px", "2-5 px", "5-10 px", "10-20 px", "20-40 px", "40 px and more",
    ]  # fmt: skip
    assert [label for group, label in STRATA if group == "region"][::4] == ["top left", "middle centre", "bottom right"]
    assert STRATUM_SUMS == ("count", "abs_rel", "squared", "absolute", "delta1")


@given(seed=SEEDS)
def test_each_bin_agrees_with_loops_over_pixels(seed: int) -> None:
    pred, target, valid = make_case(seed)
    sums = strata_sums(pred, target, valid)
    assert sums.dtype == torch.float64
    for image in range(len(sums)):
        expected = oracle_sums(*(x[image, 0].numpy() for x in (pred, target, valid)))
        np.testing.assert_allclose(sums[image].numpy(), expected, rtol=1e-5, atol=1e-5)


def test_the_cases_reach_every_bin() -> None:
    assert (sum(strata_sums(*make_case(seed)).sum(dim=0) for seed in range(4))[:, 0] > 0).all()  # type: ignore[index]


@given(seed=SEEDS, height=st.integers(1, 9), width=st.integers(1, 9), share=st.floats(0, 1))
def test_each_group_parts_the_valid_pixels(seed: int, height: int, width: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    target, pred = (torch.tensor(rng.uniform(0.1, 12, (2, 1, height, width))).float() for _ in range(2))
    valid = torch.tensor(rng.random((2, 1, height, width)) < share)
    whole = depth_sums(pred, target, valid)
    for sums in by_group(strata_sums(pred, target, valid)).values():
        assert sums[:, 0].equal(valid.sum(dim=(1, 2, 3)).double())
        for column, name in enumerate(STRATUM_SUMS):
            torch.testing.assert_close(sums[:, column], whole[name], rtol=1e-5, atol=1e-5)


@given(seed=SEEDS, junk=st.sampled_from([math.nan, math.inf, -math.inf, -1.0, 0.0]))
def test_invalid_pixels_change_nothing(seed: int, junk: float) -> None:
    pred, target, valid = make_case(seed)
    dirty = strata_sums(torch.where(valid, pred, junk), torch.where(valid, target, junk), valid)
    assert dirty.equal(strata_sums(pred, target, valid))


@given(seed=SEEDS)
def test_images_do_not_touch_each_other(seed: int) -> None:
    case = make_case(seed, batch=3)
    together = strata_sums(*case)
    assert together.equal(torch.cat([strata_sums(*(x[i : i + 1] for x in case)) for i in range(3)]))


def test_many_images_at_once() -> None:
    case = make_case(batch=1, height=6, width=12)
    assert strata_sums(*(x.repeat(300, 1, 1, 1) for x in case)).equal(strata_sums(*case).repeat(300, 1, 1))


def test_a_depth_between_two_bins_lies_in_the_farther() -> None:
    target = torch.tensor([0.5, 1.0, 1.999, 4.0, 8.0, 9.5]).view(1, 1, 1, 6)
    found = stratum(target, target, torch.ones_like(target, dtype=torch.bool), "depth")
    counts = {label: row[0] for label, row in found.items()}
    assert counts == {"0-1 m": 1, "1-2 m": 2, "4-6 m": 1, "8 m and more": 2}


def test_regions_are_thirds_of_what_is_scored() -> None:
    target = torch.full((1, 1, 3, 7), 2.0)  # columns 0-2, 3-4, 5-6
    pred = target.clone()
    pred[..., 1, 4] = 3.0
    found = stratum(pred, target, torch.ones_like(target, dtype=torch.bool), "region")
    assert [row[0] for row in found.values()] == [3, 2, 2] * 3
    assert found.pop("middle centre") == [2, 0.5, 1, 1, 1]
    assert all(row[3] == 0 for row in found.values())


def test_the_distance_is_to_the_two_pixels_of_a_step() -> None:
    depth = np.where(np.arange(60) < 10, 1.0, 2.0)[None].repeat(5, axis=0).astype(np.float32)
    expected = [*range(9, 0, -1), 0, 0, *range(1, 50)]
    distances = edge_distance_px(depth, np.ones(depth.shape, np.bool_))
    assert (distances == expected).all()
    found = stratum(*(torch.tensor(depth)[None, None],) * 2, torch.ones(1, 1, 5, 60, dtype=torch.bool), "edge distance")
    assert [row[0] / 5 for row in found.values()] == [4, 6, 10, 10, 20, 10]


@pytest.mark.parametrize(("far", "edges"), [(1.09, 0), (1.11, 2)])
def test_a_step_is_more_than_ten_percent(far: float, edges: int) -> None:
    for depth in (np.array([[1.0, far]], np.float32), np.array([[far], [1.0]], np.float32)):
        assert (edge_distance_px(depth, np.ones(depth.shape, np.bool_)) == 0).sum() == edges


def test_a_hole_makes_no_edge() -> None:
    depth = np.array([[1.0, 0.0, 2.0]], np.float32)
    assert np.isinf(edge_distance_px(depth, depth > 0)).all()


def test_without_an_edge_every_pixel_is_far_from_one() -> None:
    target = torch.full((1, 1, 4, 5), 3.0)
    found = stratum(target, target, torch.ones_like(target, dtype=torch.bool), "edge distance")
    assert found == {"40 px and more": [20, 0, 0, 0, 20]}


@given(seed=SEEDS)
def test_distances_are_exact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((40, 50)) < 0.004, 1.0, 2.0)
    valid = rng.random(depth.shape) > 0.05
    found = edge_distance_px(depth.astype(np.float32), valid)
    np.testing.assert_allclose(found, oracle_distances(depth, valid), rtol=1e-5)


def test_a_prediction_of_nan_is_not_hidden_and_stays_in_its_bins() -> None:
    pred, target, valid = make_case()
    valid[0, 0, 0, 0], pred[0, 0, 0, 0] = True, torch.nan
    sums = strata_sums(pred, target, valid)
    assert sums[0, :, 1].isnan().sum() == len(GROUPS)
    assert sums[1].isfinite().all()
    assert sums[..., 0].isfinite().all()


def test_half_precision_is_summed_in_full() -> None:
    pred, target, valid = make_case()
    low, full = (strata_sums(x, target.float(), valid) for x in (pred.bfloat16(), pred.bfloat16().float()))
    assert low.equal(full)


# summary


def summary(rows: list[Stratum], group: str) -> dict[str, Stratum]:
    return {row.label: row for row in rows if row.group == group}


def test_bins_are_pooled_over_their_pixels() -> None:
    sums = torch.zeros(3, len(STRATA), 5, dtype=torch.float64)
    sums[0, 1] = torch.tensor([10.0, 1.0, 4.0, 5.0, 8.0])
    sums[2, 1] = torch.tensor([30.0, 7.0, 6.0, 15.0, 12.0])
    sums[1, 3] = torch.tensor([60.0, 6.0, 0.0, 0.0, 60.0])
    first, second = summarise_strata(sums, ["", "", ""])
    assert astuple(first) == ("depth", "1-2 m", 2, 0.4, pytest.approx(0.2), pytest.approx(0.5), 0.5, 0.5)
    assert astuple(second) == ("depth", "3-4 m", 1, 0.6, pytest.approx(0.1), 0.0, 0.0, 1.0)


@given(seed=SEEDS)
def test_shares_of_each_group_add_up_to_one(seed: int) -> None:
    rows = summarise_strata(strata_sums(*make_case(seed, batch=3)), ["a", "b", ""])
    assert [*dict.fromkeys(row.group for row in rows)] == [*GROUPS, "category"]
    for group in (*GROUPS, "category"):
        assert sum(row.share for row in summary(rows, group).values()) == pytest.approx(1)


def test_a_category_is_what_its_images_reach_alone() -> None:
    pred, target, valid = make_case(batch=3)
    rows = summary(summarise_strata(strata_sums(pred, target, valid), ["den", "", "den"]), "category")
    assert {label: row.images for label, row in rows.items()} == {"den": 2, "unknown": 1}
    members = [0, 2]
    p, t = (x[members][valid[members]].numpy() for x in (pred, target))
    den = rows["den"]
    assert den.abs_rel == pytest.approx(np.mean(np.abs(p - t) / t))
    assert den.rmse == pytest.approx(np.sqrt(np.mean((p - t) ** 2)))
    assert den.mae == pytest.approx(np.mean(np.abs(p - t)))
    assert den.delta1 == pytest.approx(np.mean(np.maximum(p / t, t / p) < 1.25))
    assert den.share == pytest.approx(len(p) / valid.sum().item())


def test_no_group_of_categories_where_none_is_known() -> None:
    assert not summary(summarise_strata(strata_sums(*make_case()), ["", ""]), "category")


@pytest.mark.parametrize("count", [12, 13, 30])
def test_most_pixels_first_and_the_smallest_are_others(count: int) -> None:
    sums = torch.zeros(count, len(STRATA), 5, dtype=torch.float64)
    sums[:, 0, 0] = torch.arange(1, count + 1)
    rows = summary(summarise_strata(sums, [f"c{i:02d}" for i in range(count)]), "category")
    largest = [f"c{i:02d}" for i in reversed(range(count))]
    assert list(rows) == (largest if count == 12 else [*largest[:11], "other"])
    if count > 12:
        assert rows["other"].images == count - 11


def test_images_without_a_pixel() -> None:
    sums = torch.zeros(2, len(STRATA), 5, dtype=torch.float64)
    assert summarise_strata(sums, ["a", "b"]) == []
    sums[0, 0] = torch.tensor([2.0, 1.0, 1.0, 1.0, 0.0])
    assert [(row.group, row.label, row.images) for row in summarise_strata(sums, ["a", "b"])] == [
        ("depth", "0-1 m", 1), ("category", "a", 1),
    ]  # fmt: skip


def test_csv_has_the_fields_and_rounds_to_six_digits() -> None:
    text = strata_csv([Stratum("category", 'a, "b"', 3, 1 / 3, 0.1, 0.25, 1.0, 0.987654321)])
    header, row = csv.reader(io.StringIO(text))
    assert header == ["group", "label", "images", "share", "abs_rel", "rmse", "mae", "delta1"]
    assert row == ["category", 'a, "b"', "3", "0.333333", "0.1", "0.25", "1", "0.987654"]
    assert strata_csv([]) == ",".join(header) + "\n"


@given(seed=st.integers(0, 1000))
def test_depth_of_zero_or_less_is_never_close(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = torch.tensor(rng.uniform(0.5, 10, (2, 1, 6, 7))).float()
    pred, valid = target * torch.tensor(rng.uniform(-1.2, 1.2, target.shape)).float(), torch.ones_like(target).bool()
    torch.testing.assert_close(
        strata_sums(pred, target, valid)[:, :7, 4].sum(1), depth_sums(pred, target, valid)["delta1"]
    )


def test_half_precision_of_both_is_summed_in_full() -> None:
    rng = np.random.default_rng(0)
    pred, target = (torch.tensor(rng.uniform(0.5, 10, (1, 1, 30, 70))).bfloat16() for _ in range(2))
    valid = torch.ones_like(target).bool()
    assert strata_sums(pred, target, valid).equal(strata_sums(pred.float(), target.float(), valid))
