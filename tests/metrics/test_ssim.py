from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from skimage.metrics import structural_similarity
from torch import Tensor
from torchmetrics.image import StructuralSimilarityIndexMeasure

from hudepth.base.errors import ConfigError
from hudepth.metrics.ssim import gaussian, ssim, ssim_map, window_sum


def make_pair(seed: int = 0, *, batch: int = 2, height: int = 24, width: int = 30) -> tuple[Tensor, Tensor]:
    """Return smooth unit depth and a noisy version of it."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width]
    slopes = rng.uniform(-0.4, 0.4, (2, batch, 1, 1, 1))
    target = 0.5 + slopes[0] * rows / height + slopes[1] * columns / width
    target = np.where(columns > rng.uniform(5, 25), target, 0.7 * target)
    pred = target + rng.normal(0, 0.03, target.shape)
    return torch.tensor(pred).float().clamp(0, 1), torch.tensor(target).float().clamp(0, 1)


def oracle_map(pred: NDArray[Any], target: NDArray[Any], *, data_range: float) -> NDArray[Any]:
    """Window by window in float64, from the definition."""
    offsets = np.arange(11) - 5
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    out = np.empty((pred.shape[0] - 10, pred.shape[1] - 10))
    for y, x in np.ndindex(*out.shape):
        p, t = pred[y : y + 11, x : x + 11], target[y : y + 11, x : x + 11]
        mean_p, mean_t = (weights * p).sum(), (weights * t).sum()
        var_p, var_t = (weights * (p - mean_p) ** 2).sum(), (weights * (t - mean_t) ** 2).sum()
        cov = (weights * (p - mean_p) * (t - mean_t)).sum()
        luminance = (2 * mean_p * mean_t + c1) / (mean_p**2 + mean_t**2 + c1)
        out[y, x] = luminance * (2 * cov + c2) / (var_p + var_t + c2)
    return out


@pytest.mark.parametrize("data_range", [1.0, 10.0])
def test_map_agrees_with_the_definition(data_range: float) -> None:
    pred, target = (data_range * x for x in make_pair())
    values = ssim_map(pred, target, data_range=data_range)
    assert values.shape == (2, 1, 14, 20)
    for image in range(2):
        expected = oracle_map(pred[image, 0].double().numpy(), target[image, 0].double().numpy(), data_range=data_range)
        np.testing.assert_allclose(values[image, 0].numpy(), expected, atol=1e-4)
        doubles = ssim_map(pred.double(), target.double(), data_range=data_range)
        np.testing.assert_allclose(doubles[image, 0].numpy(), expected, atol=1e-11)


@given(seed=st.integers(0, 1000))
def test_mean_agrees_with_scikit_image_and_torchmetrics(seed: int) -> None:
    pred, target = make_pair(seed)
    values = ssim(pred, target, data_range=1.0)
    for image in range(2):
        expected = structural_similarity(  # type: ignore[no-untyped-call]
            pred[image, 0].double().numpy(),
            target[image, 0].double().numpy(),
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
        assert values[image].item() == pytest.approx(expected, abs=1e-5)
    metric = StructuralSimilarityIndexMeasure(data_range=1.0, return_full_image=True)
    _, reference = metric(pred.double(), target.double())  # its float32 is off by 1e-5
    inside = reference[:, :, 5:-5, 5:-5]  # without the windows over its reflected border
    assert values.mean().item() == pytest.approx(inside.mean().item(), abs=1e-5)


def test_mask_keeps_the_windows_whose_pixels_are_all_valid() -> None:
    pred, target = make_pair()
    valid = torch.ones_like(target, dtype=torch.bool)
    valid[:, :, 20, 3] = False
    valid[:, :, 0, 29] = False
    values = ssim_map(pred, target, data_range=1.0).double()
    mean = ssim(pred, target, valid, data_range=1.0)
    for image in range(2):
        kept = [
            values[image, 0, y, x].item()
            for y, x in np.ndindex(14, 20)
            if valid[image, 0, y : y + 11, x : x + 11].all()
        ]
        assert 0 < len(kept) < 14 * 20
        assert mean[image].item() == pytest.approx(sum(kept) / len(kept), rel=1e-6)


@given(seed=st.integers(0, 1000), junk=st.sampled_from([math.nan, math.inf, -5.0, 1e30]))
def test_invalid_pixels_change_nothing(seed: int, junk: float) -> None:
    pred, target = make_pair(seed)
    valid = torch.ones_like(target, dtype=torch.bool)
    valid[:, :, :3, :4] = False
    clean = ssim(pred, target, valid, data_range=1.0)
    dirty = ssim(torch.where(valid, pred, junk), torch.where(valid, target, junk), valid, data_range=1.0)
    assert dirty.equal(clean)


@given(seed=st.integers(0, 1000))
def test_identity_is_one_and_order_does_not_matter(seed: int) -> None:
    pred, target = make_pair(seed)
    assert ssim(target, target, data_range=1.0).tolist() == pytest.approx([1.0, 1.0], abs=1e-6)
    forth, back = ssim(pred, target, data_range=1.0), ssim(target, pred, data_range=1.0)
    assert forth.tolist() == pytest.approx(back.tolist(), abs=1e-6)
    assert (forth < 1).all()


def test_data_range_scales_with_the_unit() -> None:
    pred, target = make_pair()
    metres = ssim(10 * pred, 10 * target, data_range=10.0)
    assert metres.tolist() == pytest.approx(ssim(pred, target, data_range=1.0).tolist(), abs=1e-5)


def test_constant_zeros_are_finite() -> None:
    zeros = torch.zeros(1, 1, 11, 11)
    assert ssim(zeros, zeros, data_range=1.0).tolist() == pytest.approx([1.0])


def test_an_image_without_a_whole_window_is_nan() -> None:
    pred, target = make_pair()
    valid = torch.ones_like(target, dtype=torch.bool)
    valid[0, :, 10:14, 10:20] = False
    valid[0, :, :, ::10] = False
    values = ssim(pred, target, valid, data_range=1.0)
    assert values.isnan().tolist() == [True, False]


def test_half_precision_under_autocast_costs_only_the_rounding_of_the_input() -> None:
    pred, target = make_pair()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        value = ssim(pred.bfloat16(), target, data_range=1.0)
    assert value.dtype == torch.float32
    assert value.equal(ssim(pred.bfloat16().float(), target, data_range=1.0))


def test_gradient_agrees_with_finite_differences() -> None:
    pred, target = (x[:1, :, :12, :12].double() for x in make_pair())
    pred.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: ssim(p, target, data_range=1.0), (pred,))


def test_window_of_another_size() -> None:
    pred, target = make_pair()
    assert ssim_map(pred, target, data_range=1.0, window=5, sigma=0.8).shape == (2, 1, 20, 26)
    assert gaussian(5, 0.8) == gaussian(5, 0.8)[::-1]
    assert sum(gaussian(5, 0.8)) == pytest.approx(1.0)
    counts = window_sum(torch.ones(1, 1, 6, 7), [1.0] * 5)
    assert counts.tolist() == [[[[25.0] * 3] * 2]]


@pytest.mark.parametrize("measure", [ssim_map, ssim])
@pytest.mark.parametrize(("height", "width"), [(10, 30), (30, 10)])
def test_an_image_smaller_than_the_window_says_so(measure: Any, height: int, width: int) -> None:
    image = torch.zeros(1, 1, height, width)
    with pytest.raises(ConfigError) as caught:
        measure(image, image, data_range=1.0)
    assert str(caught.value) == (
        f"ssim: a {height} x {width} image has no window of 11 x 11 pixels. Use images of at least 11 x 11."
    )
