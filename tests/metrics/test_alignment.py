from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from hudepth.base.errors import ConfigError
from hudepth.metrics.alignment import ALIGNMENTS, MAX_DEPTH_M, align

SEEDS = st.integers(0, 1000)
KINDS = [kind for kind in ALIGNMENTS if kind != "none"]


def make_case(
    seed: int = 0, *, batch: int = 2, dtype: torch.dtype = torch.float64, noise: float = 0.1
) -> tuple[Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    target = rng.uniform(0.5, 10, (batch, 1, 6, 7))
    pred = (0.4 * target + 0.3) * rng.lognormal(0, noise, target.shape)
    valid = rng.random(target.shape) > 0.3
    valid[:, 0, 0, :3] = True
    return torch.tensor(pred).to(dtype), torch.tensor(target).to(dtype), torch.tensor(valid)


def fit(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, float]:
    solution = np.linalg.lstsq(np.stack([x, np.ones_like(x)], axis=1), y, rcond=None)[0]
    return float(solution[0]), float(solution[1])


def oracle(pred: NDArray[Any], target: NDArray[Any], valid: NDArray[Any], kind: str) -> NDArray[Any]:
    p, t = pred[valid], target[valid]
    if kind == "median":
        return np.asarray(pred * np.median(t) / np.median(p))
    if kind == "least_squares":
        scale, shift = fit(p, t)
        return scale * pred + shift
    scale, shift = fit(1 / np.maximum(p, 1e-3), 1 / t)
    inverse = scale / np.maximum(pred, 1e-3) + shift
    return np.asarray(1 / np.maximum(inverse, 1 / MAX_DEPTH_M))


def squared_error(pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    return torch.where(valid, (pred - target).square(), 0.0).sum(dim=(1, 2, 3))


@pytest.mark.parametrize("kind", KINDS)
@given(seed=SEEDS)
def test_each_image_agrees_with_numpy(kind: str, seed: int) -> None:
    case = make_case(seed)
    aligned = align(*case, kind=kind)
    for image in range(2):
        expected = oracle(*(x[image].numpy() for x in case), kind)
        np.testing.assert_allclose(aligned[image].numpy(), expected, rtol=1e-7)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_an_even_median_is_the_mean_of_the_middle_two(count: int) -> None:
    rng = np.random.default_rng(count)
    pred, target = (torch.tensor(rng.uniform(1, 9, (1, 1, 1, count))) for _ in range(2))
    aligned = align(pred, target, torch.ones_like(pred, dtype=torch.bool), kind="median")
    assert np.median(aligned.numpy()) == pytest.approx(np.median(target.numpy()))


def test_none_changes_nothing() -> None:
    pred, target, valid = make_case()
    assert align(pred, target, valid, kind="none").equal(pred)


@given(seed=SEEDS, scale=st.floats(0.1, 10), shift=st.floats(-3, 3))
def test_least_squares_undoes_any_affine_change(seed: int, scale: float, shift: float) -> None:
    pred, target, valid = make_case(seed)
    before, after = (align(x, target, valid, kind="least_squares") for x in (pred, scale * pred + shift))
    torch.testing.assert_close(after, before, rtol=1e-8, atol=1e-8)


@given(seed=SEEDS, scale=st.floats(0.1, 10))
def test_the_median_undoes_any_scale(seed: int, scale: float) -> None:
    pred, target, valid = make_case(seed)
    before, after = (align(x, target, valid, kind="median") for x in (pred, scale * pred))
    torch.testing.assert_close(after, before, rtol=1e-12, atol=0)


@given(seed=SEEDS, scale=st.floats(0.2, 5), shift=st.floats(0, 1))
def test_affine_inverse_undoes_any_affine_change_of_inverse_depth(seed: int, scale: float, shift: float) -> None:
    pred, target, valid = make_case(seed)
    before, after = (align(x, target, valid, kind="affine_inverse") for x in (pred, 1 / (scale / pred + shift)))
    torch.testing.assert_close(after, before, rtol=1e-7, atol=0)


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("median", lambda t: 0.3 * t),
        ("least_squares", lambda t: 0.3 * t + 2),
        ("affine_inverse", lambda t: 1 / (0.3 / t + 0.2)),
    ],
)
def test_a_prediction_that_is_right_but_for_its_scale_becomes_the_truth(kind: str, change: Any) -> None:
    _, target, valid = make_case()
    torch.testing.assert_close(align(change(target), target, valid, kind=kind), target, rtol=1e-9, atol=0)


@given(seed=SEEDS, noise=st.floats(0, 2))
def test_least_squares_is_never_worse_than_unaligned(seed: int, noise: float) -> None:
    pred, target, valid = make_case(seed, noise=noise)
    aligned = align(pred, target, valid, kind="least_squares")
    before, after = (squared_error(x, target, valid) for x in (pred, aligned))
    assert (after <= before * (1 + 1e-9) + 1e-9).all()


@pytest.mark.parametrize("kind", ALIGNMENTS)
@given(seed=SEEDS, junk=st.sampled_from([math.nan, math.inf, -math.inf, -1.0, 0.0, 1e30]))
def test_invalid_pixels_change_nothing(kind: str, seed: int, junk: float) -> None:
    pred, target, valid = make_case(seed)
    clean = align(pred, target, valid, kind=kind)
    dirty = align(torch.where(valid, pred, junk), torch.where(valid, target, junk), valid, kind=kind)
    assert dirty[valid].equal(clean[valid])


@pytest.mark.parametrize("kind", ALIGNMENTS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_the_type_stays(kind: str, dtype: torch.dtype) -> None:
    pred, target, valid = make_case(dtype=dtype)
    aligned = align(pred, target, valid, kind=kind)
    assert aligned.dtype == dtype
    exact = align(pred.double(), target.double(), valid, kind=kind)
    assert aligned.equal(exact.to(dtype))


@pytest.mark.parametrize("kind", KINDS)
def test_images_do_not_touch_each_other(kind: str) -> None:
    case = make_case(batch=3)
    alone = [align(*(x[i : i + 1] for x in case), kind=kind) for i in range(3)]
    assert align(*case, kind=kind).equal(torch.cat(alone))


@pytest.mark.parametrize("kind", ALIGNMENTS)
def test_an_image_without_a_valid_pixel_is_returned_as_it_is(kind: str) -> None:
    pred, target, valid = make_case()
    valid[0] = False
    assert align(pred, torch.where(valid, target, torch.nan), valid, kind=kind)[0].equal(pred[0])


@pytest.mark.parametrize("constant", [0.0, 0.1, 3.0])
def test_a_constant_prediction_is_shifted(constant: float) -> None:
    _, target, valid = make_case(batch=1, dtype=torch.float32)
    pred = torch.full_like(target, constant)
    t = target[valid].double()
    expected = {"least_squares": t.mean(), "affine_inverse": 1 / (1 / t).mean()}
    if constant > 0:
        expected["median"] = torch.tensor(np.median(t))
    for kind, value in expected.items():
        aligned = align(pred, target, valid, kind=kind)
        torch.testing.assert_close(aligned, torch.full_like(target, value.item()), rtol=1e-5, atol=0)


def test_one_valid_pixel_is_met() -> None:
    pred, target, valid = make_case(batch=1)
    valid[:] = False
    valid[0, 0, 2, 3] = True
    for kind in KINDS:
        assert align(pred, target, valid, kind=kind)[0, 0, 2, 3].item() == pytest.approx(target[0, 0, 2, 3].item())


@pytest.mark.parametrize("middle", [0.0, -2.0])
def test_a_median_that_cannot_be_scaled(middle: float) -> None:
    _, target, valid = make_case(batch=1)
    pred = torch.full_like(target, middle)
    assert align(pred, target, valid, kind="median").equal(pred)


@given(seed=SEEDS)
def test_affine_inverse_stays_before_the_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pred, target = (torch.tensor(rng.uniform(low, 10, (1, 1, 6, 7))).float() for low in (-1, 0.1))
    valid = torch.tensor(rng.random(target.shape) > 0.5)
    aligned = align(pred, target, valid, kind="affine_inverse")
    assert aligned.isfinite().all()
    assert (aligned > 0).all()
    assert (aligned[valid] <= MAX_DEPTH_M * (1 + 1e-6)).all()


def test_inverse_depth_of_zero_or_less_becomes_the_farthest_depth() -> None:
    target = torch.tensor([1.0, 2.0, 4.0, 9.0]).view(1, 1, 1, 4)
    pred = torch.tensor([1.0, 2.0, 4.0, 1e9]).view(1, 1, 1, 4)
    valid = torch.tensor([True, True, True, False]).view(1, 1, 1, 4)
    shifted = 1 / (1 / pred + 0.1)  # undoing it takes 0.1 off the inverse, from 0.1 to 0
    aligned = align(shifted, target, valid, kind="affine_inverse").flatten()
    assert aligned[:3].tolist() == pytest.approx([1, 2, 4], rel=1e-5)
    assert aligned[3].item() == pytest.approx(MAX_DEPTH_M)


@pytest.mark.parametrize("kind", KINDS)
def test_a_prediction_of_nan_is_not_hidden(kind: str) -> None:
    pred, target, valid = make_case()
    pred[0, 0, 0, 0] = torch.nan
    aligned = align(pred, target, valid, kind=kind)
    assert aligned[0, 0, 0, 0].isnan()
    assert aligned[1].isfinite().all()


@pytest.mark.parametrize(
    ("kind", "hint"),
    [("medain", " Did you mean 'median'?"), ("least-squares", " Did you mean 'least_squares'?"), ("x", "")],
)
def test_unknown_kind(kind: str, hint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        align(*make_case(), kind=kind)
    expected = f"alignment: no '{kind}'.{hint} Pass one of none, median, least_squares, affine_inverse."
    assert str(caught.value) == expected


@given(seed=st.integers(0, 1000), scale=st.floats(-10, -0.1), shift=st.floats(-3, 3))
def test_least_squares_undoes_a_negative_scale(seed: int, scale: float, shift: float) -> None:
    rng = np.random.default_rng(seed)
    pred, target = (torch.tensor(rng.uniform(0.5, 10, (2, 1, 6, 7))) for _ in range(2))
    valid = torch.tensor(rng.random(pred.shape) > 0.2)
    before, after = (align(x, target, valid, kind="least_squares") for x in (pred, scale * pred + shift))
    torch.testing.assert_close(after, before, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("constant", [0.1, 0.3, 2.7])
@pytest.mark.parametrize("count", range(3, 60))
def test_rounding_noise_of_a_constant_is_no_slope(constant: float, count: int) -> None:
    rng = np.random.default_rng(count)
    target = torch.tensor(rng.uniform(1, 9, (1, 1, 1, count)))
    pred = torch.full_like(target, constant)
    pred[..., 0], valid = 1.0, torch.ones_like(target, dtype=torch.bool)
    valid[..., 0] = False  # scored where the fit did not look, a slope made of noise shows
    aligned = align(pred, target, valid, kind="least_squares")
    assert aligned[0, 0, 0, 0].item() == pytest.approx(target[valid].mean().item() + 1.0 - constant)


def test_an_infinite_prediction_is_not_hidden() -> None:
    pred, target = torch.full((1, 1, 2, 3), 2.0), torch.full((1, 1, 2, 3), 3.0)
    pred[..., 0, 0] = math.inf
    for kind in ALIGNMENTS[1:]:
        aligned = align(pred, target, torch.ones_like(pred, dtype=torch.bool), kind=kind)
        assert not aligned[0, 0, 0, 0].isfinite(), kind


def test_inverse_depth_is_fitted_as_it_is() -> None:
    """Also where it is 0 or negative, which no depth is the inverse of."""
    truth = torch.rand(2, 1, 5, 7, dtype=torch.float64) + 0.5
    stated = 1 / truth * torch.tensor([2.0, -0.3], dtype=torch.float64)[:, None, None, None] - 1.5
    aligned = align(stated, truth, torch.ones_like(truth, dtype=torch.bool), kind="affine_inverse", inverse=True)
    torch.testing.assert_close(aligned, truth)
    with pytest.raises(ConfigError, match="alignment: 'median' is not for inverse depth"):
        align(stated, truth, truth > 0, kind="median", inverse=True)
