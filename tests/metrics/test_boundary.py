from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage
from skimage.feature import canny
from torch import Tensor

from hudepth.metrics.boundary import (
    BOUNDARY_NAMES,
    boundary_metrics,
    depth_boundary_errors,
    edge_scores,
    si_boundary_f1,
)
from hudepth.metrics.canny import canny_edges, chamfer_px

PUBLISHED_CANNY = {"sigma_px": 2**0.5, "low": 0.15, "high": 0.3}
RATIOS = np.linspace(1.05, 1.25, 10)
SEEDS = st.integers(0, 1000)


def make_room(rng: np.random.Generator, height: int, width: int, *, boxes: int = 4) -> NDArray[np.float64]:
    """A slanted wall with boxes before it [m]."""
    rows, columns = np.mgrid[:height, :width]
    depth = 3 + rng.uniform(-1, 1) * rows / height + rng.uniform(-1, 1) * columns / width
    for _ in range(boxes):
        top, left = rng.integers(1, height - 6), rng.integers(1, width - 6)
        bottom, right = top + rng.integers(4, height // 2), left + rng.integers(4, width // 2)
        depth[top:bottom, left:right] *= rng.uniform(0.5, 0.95)
    return depth


def make_case(
    seed: int = 0, *, batch: int = 2, height: int = 24, width: int = 30, holes: float = 0.03
) -> tuple[Tensor, Tensor, Tensor]:
    """Rooms, a blurred and noisy prediction of each, and masks with holes."""
    rng = np.random.default_rng(seed)
    target = np.stack([make_room(rng, height, width) for _ in range(batch)])[:, None]
    pred = ndimage.gaussian_filter(target, (0, 0, 0.6, 0.6)) * rng.lognormal(0, 0.01, target.shape)
    return torch.tensor(pred), torch.tensor(target), torch.tensor(rng.random(target.shape) >= holes)


def step(at: int, *, near_m: float = 1.0, far_m: float = 2.0, height: int = 40, width: int = 60) -> Tensor:
    """One map with ``near_m`` left of column ``at`` and ``far_m`` from there on."""
    depth = torch.full((1, 1, height, width), near_m)
    depth[..., at:] = far_m
    return depth


def everywhere(depth: Tensor) -> Tensor:
    return torch.ones_like(depth, dtype=torch.bool)


def ratio_or_nan(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


# edge pixels


def oracle_edges(depth: NDArray[Any], valid: NDArray[Any], threshold: float) -> set[tuple[int, int]]:
    """Window by window, from the kernels."""
    kernel = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]])
    found = set()
    for y in range(1, depth.shape[0] - 1):
        for x in range(1, depth.shape[1] - 1):
            window = np.s_[y - 1 : y + 2, x - 1 : x + 2]
            if valid[window].all():
                slope = math.hypot((kernel * depth[window]).sum(), (kernel.T * depth[window]).sum())
                found |= {(y, x)} if slope > threshold else set()
    return found


@pytest.mark.parametrize("threshold", [0.25, 0.5, 1.0])
@given(seed=SEEDS)
def test_edge_scores_agree_with_the_definition(threshold: float, seed: int) -> None:
    pred, target, valid = make_case(seed)
    scores = edge_scores(pred, target, valid, threshold=threshold)
    for i in range(2):
        mask = valid[i, 0].numpy()
        p, t = (oracle_edges(x[i, 0].numpy(), mask, threshold) for x in (pred, target))
        precision, recall = len(p & t) / max(len(p), 1), ratio_or_nan(len(p & t), len(t))
        if not t:
            precision = math.nan
        f1 = 2 * precision * recall / (precision + recall) if p & t else 0 * recall
        expected = {"precision": precision, "recall": recall, "f1": f1}
        assert {name: x[i].item() for name, x in scores.items()} == pytest.approx(expected, nan_ok=True)


def test_a_step_gives_four_times_its_height() -> None:
    flat = step(30, far_m=1.0)
    for height_m, found in ((0.0625, False), (0.0626, True)):
        truth = step(30, far_m=1 + height_m)
        recall = edge_scores(truth, truth, everywhere(truth), threshold=0.25)["recall"]
        assert recall.item() == 1 if found else recall.isnan().item()
        missed = edge_scores(flat, truth, everywhere(truth), threshold=0.25)
        assert all(x.item() == 0 if found else x.isnan().item() for x in missed.values())


def test_a_step_one_pixel_off_shares_half_its_edge_pixels() -> None:
    truth, pred = step(30), step(31)  # edge pixels in columns 29, 30 and 30, 31
    scores = edge_scores(pred, truth, everywhere(truth), threshold=0.5)
    assert [x.item() for x in scores.values()] == [0.5, 0.5, 0.5]


def test_a_blurred_step_loses_recall_at_high_thresholds() -> None:
    truth = step(30)
    pred = torch.tensor(ndimage.uniform_filter(truth.numpy(), (1, 1, 1, 10)))  # rises 0.1 m a pixel: slope 0.8
    recalls = [edge_scores(pred, truth, everywhere(truth), threshold=t)["recall"].item() for t in (0.25, 0.5, 1)]
    assert recalls == [1, 1, 0]
    precision = edge_scores(pred, truth, everywhere(truth), threshold=0.5)["precision"].item()
    assert 0 < precision < 0.25  # ten columns where there are two


# scale-invariant F1


def oracle_occlusions(depth: NDArray[Any], valid: NDArray[Any], ratio: float) -> list[set[tuple[int, int]]]:
    """For each direction, the pixels more than ``ratio`` times as deep as their neighbour there."""
    height, width = depth.shape
    out = []
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        found = set()
        for y, x in np.ndindex(height, width):
            v, u = y + dy, x + dx
            inside = 0 <= v < height and 0 <= u < width and valid[y, x] and valid[v, u]
            if inside and max(depth[y, x], 1e-3) / max(depth[v, u], 1e-3) > ratio:
                found.add((y, x))
        out.append(found)
    return out


def oracle_si_f1(pred: NDArray[Any], target: NDArray[Any], valid: NDArray[Any]) -> float:
    total = weights = 0.0
    for ratio in RATIOS:
        directions = list(zip(*(oracle_occlusions(depth, valid, ratio) for depth in (pred, target)), strict=True))
        recalls = [len(p & t) / len(t) for p, t in directions if t]
        precisions = [len(p & t) / max(len(p), 1) for p, t in directions if p or t]
        if recalls:
            r, p = np.mean(recalls), np.mean(precisions)
            total += ratio * (2 * p * r / (p + r) if p + r else 0.0)
            weights += ratio
    return ratio_or_nan(total, weights)


def published_si_f1(pred: NDArray[Any], target: NDArray[Any]) -> float:
    """The authors' convention: a direction without occlusions scores 0."""
    everything = np.ones(pred.shape, bool)
    scores = []
    for ratio in RATIOS:
        p_sets, t_sets = (oracle_occlusions(depth, everything, ratio) for depth in (pred, target))
        hits = [len(p & t) for p, t in zip(p_sets, t_sets, strict=True)]
        recall = sum(hit / max(len(t), 1) for hit, t in zip(hits, t_sets, strict=True)) / 4
        precision = sum(hit / max(len(p), 1) for hit, p in zip(hits, p_sets, strict=True)) / 4
        scores.append(2 * precision * recall / (precision + recall) if precision + recall else 0.0)
    return float(np.average(scores, weights=RATIOS))


@given(seed=SEEDS)
def test_si_f1_agrees_with_the_definition(seed: int) -> None:
    pred, target, valid = make_case(seed, height=14, width=16)
    pred[:, :, 5, 5:8] = torch.tensor([-1.0, 0.0, 1e-4])  # all count as 1 mm
    values = si_boundary_f1(pred, target, valid)
    for i in range(2):
        expected = oracle_si_f1(pred[i, 0].numpy(), target[i, 0].numpy(), valid[i, 0].numpy())
        assert values[i].item() == pytest.approx(expected, nan_ok=True)


@given(seed=SEEDS)
def test_si_f1_is_the_published_number_where_all_directions_occur(seed: int) -> None:
    pred, target, valid = make_case(seed, batch=1, height=16, width=16, holes=0)
    target[..., 4:9, 4:9] = 0.5  # before everything: occludes on all its sides at all ratios
    expected = published_si_f1(pred[0, 0].numpy(), target[0, 0].numpy())
    assert si_boundary_f1(pred, target, valid).item() == pytest.approx(expected)


@pytest.mark.parametrize("dim", [-1, -2])
@pytest.mark.parametrize("mirrored", [False, True])
def test_si_f1_of_a_step_is_the_weight_of_the_ratios_it_passes(dim: int, mirrored: bool) -> None:
    truth, lower = step(30), step(30, far_m=1.15)
    if dim == -2:
        truth, lower = truth.mT, lower.mT
    if mirrored:
        truth, lower = truth.flip(dim), lower.flip(dim)
    expected = RATIOS[RATIOS < 1.15].sum() / RATIOS.sum()
    assert si_boundary_f1(lower, truth, everywhere(truth)).item() == pytest.approx(expected)
    assert si_boundary_f1(truth.roll(1, dims=dim), truth, everywhere(truth)).item() == 0
    assert si_boundary_f1(truth.flip(dim), truth, everywhere(truth)).item() == 0  # the other side is nearer


def test_si_f1_thresholds_themselves_do_not_pass() -> None:
    truth = step(30, far_m=1.25)
    lower = step(30, far_m=1.24)
    assert si_boundary_f1(lower, truth, everywhere(truth)).item() == 1  # 1.25 is not more than 1.25
    assert si_boundary_f1(truth, truth, everywhere(truth), min_ratio=1.25, max_ratio=1.3).isnan().item()
    assert si_boundary_f1(lower, truth, everywhere(truth), min_ratio=1.2, max_ratio=1.245, steps=2).item() < 1


@given(seed=SEEDS, scale=st.floats(0.1, 10))
def test_the_scale_of_the_prediction_matters_to_neither_ratios_nor_boundary_errors(seed: int, scale: float) -> None:
    pred, target, valid = make_case(seed)
    value = si_boundary_f1(pred, target, valid)
    torch.testing.assert_close(si_boundary_f1(scale * pred, target, valid), value, equal_nan=True)
    power = 2.0 ** round(math.log2(scale))  # a float32 rounding can move an edge pixel
    errors = depth_boundary_errors(pred, target, valid)
    torch.testing.assert_close(depth_boundary_errors(power * pred, target, valid), errors, equal_nan=True)


# boundary errors


@given(seed=SEEDS, reach_px=st.sampled_from([2.5, 10.0]))
def test_chamfer_distances_agree_with_the_definition(seed: int, reach_px: float) -> None:
    rng = np.random.default_rng(seed)
    pred, target = rng.random((2, 20, 25)) < rng.choice([0.003, 0.02])
    target[3, 4] = True
    p_points, t_points = (np.argwhere(x) for x in (pred, target))
    forth = [min(math.dist(p, t) for t in t_points) for p in p_points]
    back = [min((math.dist(t, p) for p in p_points), default=math.inf) for t in t_points]
    near = [d for d in forth if d < reach_px]
    acc = sum(near) / len(near) if near else reach_px
    comp = sum(min(d, reach_px) for d in forth + back) / len(forth + back)
    assert chamfer_px(pred, target, reach_px=reach_px) == pytest.approx((acc, comp))


@given(seed=SEEDS)
def test_chamfer_distances_agree_with_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pred, target = rng.random((2, 60, 80)) < 0.01
    to_target, to_pred = (ndimage.distance_transform_edt(~x) for x in (target, pred))
    acc = to_target[pred & (to_target < 10)].mean()
    comp = np.minimum(np.concatenate([to_target[pred], to_pred[target]]), 10).mean()
    assert chamfer_px(pred, target, reach_px=10) == pytest.approx((acc, comp))


@pytest.mark.parametrize("seed", range(5))
def test_edges_are_those_of_scikit_image(seed: int) -> None:
    """Its detector interpolates where OpenCV's rounds directions, so that pixels may move to a neighbour."""
    depth = make_room(np.random.default_rng(seed), 120, 160).astype(np.float32)
    edges = canny_edges(depth, np.ones(depth.shape, bool), **PUBLISHED_CANNY)
    unit = (depth - depth.min()) / (depth.max() - depth.min())
    expected = canny(unit, sigma=2**0.5, low_threshold=0.15, high_threshold=0.3)  # type: ignore[no-untyped-call]
    inside = np.s_[4:-4, 4:-4]  # borders are treated differently
    for one, other in ((edges, expected), (expected, edges)):
        distances = ndimage.distance_transform_edt(~other)[inside][one[inside]]
        assert len(distances) > 50
        assert (distances <= 1.5).mean() > 0.97


def test_thresholds_of_the_detector_are_sobel_magnitudes_of_unit_depth() -> None:
    truth = step(30)
    truth[..., 15:] -= 0.2  # a second, lower step: 0.2 up, of a range of 1
    depth, valid = truth[0, 0].numpy(), np.ones(truth.shape[2:], bool)
    smooth = ndimage.gaussian_filter1d((depth[0] - depth.min()) / np.ptp(depth), 2**0.5)
    peak = 4 * abs(smooth[15] - smooth[13])
    for high, found in ((peak * 1.01, False), (peak * 0.99, True)):
        edges = canny_edges(depth, valid, sigma_px=2**0.5, low=float(high), high=float(high))
        assert edges[:, 10:20].any() == found
        assert edges[:, 25:35].any(axis=1).all()


@pytest.mark.parametrize("shift_px", [-9, -1, 0, 1, 4, 9])
def test_a_shifted_step_is_as_far_off_as_it_was_shifted(shift_px: int) -> None:
    truth, pred = step(30), step(30 + shift_px)
    for swap in (False, True):
        maps = (pred.mT, truth.mT) if swap else (pred, truth)
        errors = depth_boundary_errors(*maps, everywhere(maps[0]))
        assert {name: x.tolist() for name, x in errors.items()} == {
            "acc_px": [abs(shift_px)],
            "comp_px": [abs(shift_px)],
        }


@pytest.mark.parametrize("pred", [step(40), step(45), step(30, far_m=1.0)], ids=["10 px off", "15 px off", "flat"])
def test_a_prediction_without_an_edge_nearby_gets_the_penalty(pred: Tensor) -> None:
    truth = step(30)
    errors = depth_boundary_errors(pred, truth, everywhere(truth))
    assert [x.item() for x in errors.values()] == [10, 10]


def test_a_spurious_edge_costs_completeness_only() -> None:
    truth, pred = step(20), step(20)
    pred[..., 45:] = 3.0
    acc, comp = depth_boundary_errors(pred, truth, everywhere(truth)).values()
    assert acc.item() == 0
    assert comp.item() == pytest.approx(10 / 3)  # one of three edges has no partner


def test_holes_make_no_edges() -> None:
    depth = np.full((60, 80), 2.0, np.float32)
    depth[:, 60:] = 3.0
    whole = np.ones(depth.shape, bool)
    holed = whole.copy()
    holed[10:40, 5:30] = False  # in the flat part
    holed[20:30, 55:66] = False  # across the step
    rng = np.random.default_rng(0)
    for junk in (0.0, 50.0, math.nan, rng.uniform(0, 10, depth.shape)):
        edges = canny_edges(np.where(holed, depth, junk).astype(np.float32), holed, **PUBLISHED_CANNY)
        expected = canny_edges(depth, whole, **PUBLISHED_CANNY)
        expected[18:32] = False  # within 2 px of the hole
        np.testing.assert_array_equal(edges, expected)


def test_a_hole_does_not_make_a_weak_edge_strong() -> None:
    depth = np.full((60, 80), 2.0, np.float32)
    depth[:, 40:] = 2.1  # Sobel response 0.2: between the thresholds
    depth[:, 70:] = 3.0
    holed = np.ones(depth.shape, bool)
    holed[20:45, 28:52] = False  # wider than the Gaussian
    for valid in (np.ones_like(holed), holed):
        edges = canny_edges(depth, valid, **PUBLISHED_CANNY)
        assert np.unique(np.nonzero(edges)[1]).tolist() == [69]


# all together


@given(seed=SEEDS, junk=st.sampled_from([math.nan, math.inf, -5.0, 0.0, 1e30]))
def test_invalid_pixels_change_nothing(seed: int, junk: float) -> None:
    pred, target, valid = make_case(seed)
    clean = boundary_metrics(pred, target, valid)
    dirty = boundary_metrics(torch.where(valid, pred, junk), torch.where(valid, target, junk), valid)
    torch.testing.assert_close(dirty, clean, rtol=0, atol=0, equal_nan=True)


@given(seed=SEEDS)
def test_a_batch_scores_as_each_image_alone(seed: int) -> None:
    case = make_case(seed, batch=3)
    together = boundary_metrics(*case)
    assert tuple(together) == BOUNDARY_NAMES
    assert all(values.dtype == torch.float64 and values.shape == (3,) for values in together.values())
    for i in range(3):
        alone = boundary_metrics(*(x[i : i + 1] for x in case))
        torch.testing.assert_close(
            {k: v[i : i + 1] for k, v in together.items()}, alone, rtol=0, atol=0, equal_nan=True
        )


def test_keys_are_the_scores_of_each_threshold() -> None:
    case = make_case()
    values = boundary_metrics(*case)
    for threshold in (0.25, 0.5, 1):
        for name, score in edge_scores(*case, threshold=threshold).items():
            assert values[f"edge_{name}_{threshold}"].equal(score)
    assert values["si_boundary_f1"].equal(si_boundary_f1(*case))
    errors = depth_boundary_errors(*case)
    assert values["dbe_acc_px"].equal(errors["acc_px"])
    assert values["dbe_comp_px"].equal(errors["comp_px"])


@given(seed=SEEDS)
def test_the_truth_itself_is_perfect(seed: int) -> None:
    _, target, valid = make_case(seed)
    target[..., 8:14, 8:14] = 0.5
    values = boundary_metrics(target, target, everywhere(target))
    assert {name: x.tolist() for name, x in values.items()} == {
        name: [0.0, 0.0] if name.startswith("dbe") else [1.0, 1.0] for name in BOUNDARY_NAMES
    }
    holed = boundary_metrics(target, target, valid)
    for name, x in holed.items():
        assert x[~x.isnan()].eq(0 if name.startswith("dbe") else 1).all()


@pytest.mark.parametrize("size", [(24, 30), (2, 2), (1, 5), (5, 1)])
def test_an_image_without_anything_to_compare_is_nan(size: tuple[int, int]) -> None:
    pred, target = torch.rand(2, 1, *size) + 1, torch.full((2, 1, *size), 2.0)
    target[1] = math.nan
    valid = everywhere(pred)
    valid[1] = False
    values = boundary_metrics(pred, target, valid)  # a flat truth, and one that is not measured at all
    assert all(x.isnan().all() for x in values.values())


def test_half_precision_and_gradients_are_accepted() -> None:
    pred, target, valid = make_case()
    half = pred.half()
    expected = boundary_metrics(half.float(), target.float(), valid)
    torch.testing.assert_close(boundary_metrics(half.requires_grad_(), target.float(), valid), expected, equal_nan=True)


def test_a_sharper_prediction_is_better_in_every_way() -> None:
    """Not a definition, but what the numbers are for."""
    rng = np.random.default_rng(1)
    target = torch.tensor(make_room(rng, 120, 160))[None, None]
    sharp, soft = (torch.tensor(ndimage.gaussian_filter(target.numpy(), (0, 0, s, s))) for s in (0.5, 2.5))
    better, worse = (boundary_metrics(x, target, everywhere(target)) for x in (sharp, soft))
    for name in BOUNDARY_NAMES:
        assert (better[name] < worse[name]) == name.startswith("dbe"), name
