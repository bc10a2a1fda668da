from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from hudepth.metrics.depth import METRIC_NAMES, SUM_NAMES, depth_metrics, depth_metrics_from_sums, depth_sums


def make_case(
    seed: int = 0, *, batch: int = 3, side: int = 12, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    target = rng.uniform(0.5, 10, (batch, 1, side, side))
    pred = target * rng.lognormal(0, 0.3, target.shape)
    valid = rng.random(target.shape) > 0.3
    valid[:, 0, 0, 0] = True
    return (
        torch.tensor(pred).to(dtype),
        torch.tensor(np.where(valid, target, 0)).to(dtype),
        torch.tensor(valid),
    )


def oracle(pred: NDArray[Any], target: NDArray[Any], *, lam: float = 1.0, factor: float = 100.0) -> dict[str, float]:
    """The published formulas over a flat list of valid pixels, pixel by pixel in float64."""
    pairs = [(float(p), max(float(p), 1e-3), float(t)) for p, t in zip(pred, target, strict=True)]
    n = len(pairs)
    logs = [math.log(q) - math.log(t) for _, q, t in pairs]
    mse = sum((p - t) ** 2 for p, _, t in pairs) / n
    mean_log = math.fsum(logs) / n
    return {
        "abs_rel": sum(abs(p - t) / t for p, _, t in pairs) / n,
        "sq_rel": sum((p - t) ** 2 / t for p, _, t in pairs) / n,
        "mse": mse,
        "rmse": math.sqrt(mse),
        "rmse_log": math.sqrt(sum(x * x for x in logs) / n),
        "log10": sum(abs(math.log10(q) - math.log10(t)) for _, q, t in pairs) / n,
        "silog": factor * math.sqrt(math.fsum(x * x for x in logs) / n - lam * mean_log**2),
        "mae": sum(abs(p - t) for p, _, t in pairs) / n,
        **{f"delta{k}": sum(max(q / t, t / q) < 1.25**k for _, q, t in pairs) / n for k in (1, 2, 3)},
    }


def as_floats(metrics: dict[str, Tensor], image: int) -> dict[str, float]:
    return {name: values[image].item() for name, values in metrics.items()}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("lam", "factor"), [(1.0, 100.0), (0.5, 1.0), (0.85, 10.0)])
@given(seed=st.integers(0, 1000))
def test_each_image_agrees_with_the_formulas(dtype: torch.dtype, lam: float, factor: float, seed: int) -> None:
    pred, target, valid = make_case(seed, dtype=dtype)
    metrics = depth_metrics(pred, target, valid, silog_lambda=lam, silog_factor=factor)
    assert tuple(metrics) == METRIC_NAMES
    for image, mask in enumerate(valid.numpy()):
        p, t = pred[image].double().numpy()[mask], target[image].double().numpy()[mask]
        assert as_floats(metrics, image) == pytest.approx(oracle(p, t, lam=lam, factor=factor), rel=1e-6)


def test_pooled_sums_give_the_metrics_of_pooled_pixels() -> None:
    pred, target, valid = make_case()
    sums = depth_sums(pred, target, valid)
    assert tuple(sums) == SUM_NAMES
    assert all(total.dtype == torch.float64 for total in sums.values())
    metrics = depth_metrics_from_sums({name: total.sum() for name, total in sums.items()})
    mask = valid.numpy()
    expected = oracle(pred.double().numpy()[mask], target.double().numpy()[mask])
    assert {name: value.item() for name, value in metrics.items()} == pytest.approx(expected, rel=1e-6)


def test_a_prediction_of_zero_or_less_counts_as_a_millimetre_in_logs_and_ratios() -> None:
    pred, target = (
        torch.tensor([0.0, -1.0, 2.0]).view(1, 1, 1, 3),
        torch.tensor([1.0, 2.0, 2.0]).view(1, 1, 1, 3),
    )
    metrics = as_floats(depth_metrics(pred, target, torch.ones(1, 1, 1, 3, dtype=torch.bool)), 0)
    assert metrics == pytest.approx(oracle(pred.flatten().numpy(), target.flatten().numpy()), rel=1e-6)
    assert metrics["mae"] == pytest.approx((1 + 3) / 3)
    assert metrics["log10"] == pytest.approx((3 + math.log10(2000)) / 3)


def test_delta_excludes_its_threshold() -> None:
    target = torch.tensor([1.0, 1.0, 1.25, 1.0]).view(4, 1, 1, 1)
    pred = torch.tensor([1.25, 1.2499, 1.0, 1.25**2]).view(4, 1, 1, 1)
    metrics = depth_metrics(pred, target, torch.ones(4, 1, 1, 1, dtype=torch.bool))
    assert metrics["delta1"].tolist() == [0.0, 1.0, 0.0, 0.0]
    assert metrics["delta2"].tolist() == [1.0, 1.0, 1.0, 0.0]
    assert metrics["delta3"].tolist() == [1.0, 1.0, 1.0, 1.0]


@given(seed=st.integers(0, 1000))
def test_identity_has_no_error(seed: int) -> None:
    _, target, valid = make_case(seed)
    metrics = depth_metrics(target, target, valid)
    for name, values in metrics.items():
        assert values.tolist() == [1.0 if name.startswith("delta") else 0.0] * 3


@given(seed=st.integers(0, 1000), scale=st.floats(0.1, 10.0))
def test_scaling_both_maps_leaves_relative_metrics(seed: int, scale: float) -> None:
    pred, target, valid = make_case(seed, dtype=torch.float64)
    before, after = depth_metrics(pred, target, valid), depth_metrics(scale * pred, scale * target, valid)
    for name in ("abs_rel", "rmse_log", "log10", "silog", "delta1", "delta2", "delta3"):
        assert after[name].tolist() == pytest.approx(before[name].tolist(), rel=1e-9)
    for name, power in {"mae": 1, "rmse": 1, "sq_rel": 1, "mse": 2}.items():
        assert after[name].tolist() == pytest.approx((scale**power * before[name]).tolist(), rel=1e-9)


@given(seed=st.integers(0, 1000), scale=st.floats(0.1, 10.0))
def test_silog_ignores_the_scale_of_the_prediction(seed: int, scale: float) -> None:
    pred, target, valid = make_case(seed, dtype=torch.float64)
    before, after = depth_metrics(pred, target, valid), depth_metrics(scale * pred, target, valid)
    assert after["silog"].tolist() == pytest.approx(before["silog"].tolist(), rel=1e-7)


def test_silog_of_a_scaled_truth_is_zero_in_float32() -> None:
    _, target, valid = make_case(side=64)
    assert depth_metrics(1.7 * target, target, valid)["silog"].max() < 1e-4


@given(seed=st.integers(0, 1000), junk=st.sampled_from([math.nan, math.inf, -math.inf, -1.0, 0.0, 1e30]))
def test_invalid_pixels_change_nothing(seed: int, junk: float) -> None:
    pred, target, valid = make_case(seed)
    clean = depth_metrics(pred, target, valid)
    dirty = depth_metrics(torch.where(valid, pred, junk), torch.where(valid, target, junk), valid)
    assert all(dirty[name].equal(clean[name]) for name in METRIC_NAMES)


@given(seed=st.integers(0, 1000), order=st.permutations(range(3)))
def test_order_of_the_batch_is_the_order_of_the_results(seed: int, order: list[int]) -> None:
    pred, target, valid = make_case(seed)
    straight, shuffled = (
        depth_metrics(pred, target, valid),
        depth_metrics(pred[order], target[order], valid[order]),
    )
    assert all(shuffled[name].equal(straight[name][order]) for name in METRIC_NAMES)


def test_an_image_without_valid_pixels_is_nan_and_leaves_the_others_alone() -> None:
    pred, target, valid = make_case()
    empty = valid.clone()
    empty[1] = False
    before, after = depth_metrics(pred, target, valid), depth_metrics(pred, target, empty)
    for name in METRIC_NAMES:
        assert after[name][1].isnan()
        assert after[name][[0, 2]].equal(before[name][[0, 2]])


def test_a_prediction_of_nan_is_not_hidden() -> None:
    pred, target, valid = make_case()
    pred[0, 0, 0, 0] = torch.nan
    metrics = depth_metrics(pred, target, valid)
    assert metrics["rmse"][0].isnan()
    assert metrics["silog"][0].isnan()
    assert metrics["rmse"][1:].isfinite().all()


def test_half_precision_predictions_are_measured_in_float32() -> None:
    pred, target, valid = make_case(side=64)
    rounded = pred.bfloat16()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        metrics = depth_metrics(rounded, target, valid)
    expected = depth_metrics(rounded.float(), target, valid)
    assert all(metrics[name].equal(expected[name]) for name in METRIC_NAMES)


def test_real_depth_agrees_with_the_formulas(nyu_root: Path) -> None:
    with (nyu_root / "index.csv").open(newline="") as file:
        row = next(csv.DictReader(file))
    code = cv2.imread(str(nyu_root / row["depth"]), cv2.IMREAD_UNCHANGED)
    assert code is not None
    depth_m = (code[::4, ::4] + float(row["depth_offset"])) * float(row["depth_scale_m"])
    target = torch.tensor(depth_m, dtype=torch.float32)[None, None]
    pred = target.median() + 0.5 * (target - target.median())
    valid = (target > 1e-3) & (target < 10)
    mask = valid.numpy()
    expected = oracle(pred.double().numpy()[mask], target.double().numpy()[mask])
    assert as_floats(depth_metrics(pred, target, valid), 0) == pytest.approx(expected, rel=1e-6)
