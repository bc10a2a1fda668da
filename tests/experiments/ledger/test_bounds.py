from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from experiments.ledger.bounds import largest_log10, largest_mean_depth_m, largest_rmse_m, rising
from hudepth.losses.badcl import BADCL


def figures(truth: np.ndarray, pred: np.ndarray) -> tuple[float, float, float, tuple[float, float, float]]:
    worse = np.maximum(truth / pred, pred / truth)
    deltas = tuple(float((worse < 1.25**k).mean()) for k in (1, 2, 3))
    abs_rel = float((abs(pred - truth) / truth).mean())
    log10 = float(abs(np.log10(pred / truth)).mean())
    return abs_rel, float(np.sqrt(((pred - truth) ** 2).mean())), log10, (deltas[0], deltas[1], deltas[2])


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.1, 0.5, 2.0]), st.floats(0.5, 20), st.booleans())
def test_no_data_exceeds_the_bounds(seed: int, spread: float, max_depth_m: float, far: bool) -> None:
    rng = np.random.default_rng(seed)
    truth = np.full(200, max_depth_m) if far else rng.uniform(1e-3, max_depth_m, 200)
    pred = np.clip(truth * rng.lognormal(0, spread, 200), 1e-3, max_depth_m)
    abs_rel, rmse, log10, deltas = figures(truth, pred)
    assert rmse <= largest_rmse_m(abs_rel, deltas, max_depth_m=max_depth_m, rounding=0) + 1e-9
    assert log10 <= largest_log10(abs_rel, deltas, max_depth_m=max_depth_m, rounding=0) + 1e-9


def test_means_over_images_obey_the_bound() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.1, 10, (8, 50))
    pred = np.clip(truth * rng.lognormal(0, 0.4, truth.shape), 1e-3, 10)
    images = [figures(t, p) for t, p in zip(truth, pred, strict=True)]
    abs_rel, rmse, _ = (float(np.mean([image[k] for image in images])) for k in range(3))
    deltas = [float(np.mean([image[3][k] for image in images])) for k in range(3)]
    assert rmse <= largest_rmse_m(abs_rel, deltas, max_depth_m=10, rounding=0)


def test_the_bound_is_reached() -> None:
    # half the pixels right, half at 10 m and just within 1.25: d = 2 m, r = 0.2
    bound = largest_rmse_m(0.1, (1, 1, 1), max_depth_m=10, rounding=0)
    assert math.isclose(bound, math.sqrt(0.5 * 2**2))
    # a tenth of the pixels at 10 m predicted as 0: d = 10 m, r = 1
    assert math.isclose(largest_rmse_m(0.1, (0.9, 0.9, 0.9), max_depth_m=10, rounding=0), math.sqrt(0.1 * 100))


def test_the_log10_bound_by_hand() -> None:
    # all within 1.25 and r = 0.1 on average: half the pixels at r = 0.2, where log10 is log10(1.25)
    assert math.isclose(largest_log10(0.1, (1, 1, 1), max_depth_m=10, rounding=0), 0.5 * math.log10(1.25))
    # a hundredth beyond all thresholds, from 1 mm to 10 m, the rest right
    assert math.isclose(largest_log10(0, (0.99, 0.99, 0.99), max_depth_m=10, rounding=0), 0.01 * 4)


def test_rounding_favours_the_printed_figures() -> None:
    printed = largest_rmse_m(0.072, (0.932, 0.984, 0.994), max_depth_m=10)
    assert 1.5 < largest_rmse_m(0.072, (0.932, 0.984, 0.994), max_depth_m=10, rounding=0) < printed < 1.6


RISING = [((0.8, 0.9, 1.0), True), ((0.8, 0.8, 0.8), True), ((0.81, 0.79, 0.9), False), ((0.8, 0.9, 1.1), False)]


@pytest.mark.parametrize(("deltas", "expected"), RISING)
def test_deltas_rise(deltas: tuple[float, float, float], expected: bool) -> None:
    assert rising(deltas) is expected


def test_loss_and_abs_rel_bound_the_depth() -> None:
    # 0.0006 = 3 x 0.063 x T / 10 m
    bound = largest_mean_depth_m(0.0006, abs_rel=0.063, boundary=3.0, max_depth_m=10)
    assert math.isclose(bound, 0.0006 * 10 / (3 * 0.063))


def test_badcl_never_undercuts_the_bound() -> None:
    draw = torch.Generator().manual_seed(0)
    truth = 0.05 + 0.9 * torch.rand(2, 1, 16, 16, generator=draw)
    e = 0.2 * torch.randn(truth.shape, generator=draw).clamp(-3, 3)
    image = torch.randn(2, 3, 16, 16, generator=draw)
    loss = BADCL()(truth * (1 + e), truth, image, torch.ones_like(truth, dtype=torch.bool)).total
    weighted_depth_m = float(10 * (truth * e.abs()).mean() / e.abs().mean())
    bound = largest_mean_depth_m(float(loss), abs_rel=float(e.abs().mean()), boundary=3.0, max_depth_m=10)
    assert weighted_depth_m <= bound
