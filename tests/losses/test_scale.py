from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from hudepth.losses import ImageScale
from hudepth.losses.scale import image_scale_loss


def make_case(seed: int, *, images: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    pred, target, chance = 0.02 + 0.9 * torch.rand(3, images, 1, 4, 5, generator=generator, dtype=torch.float64)
    return pred, target, chance > 0.4


@given(seed=st.integers(0, 1000))
def test_it_is_the_mean_over_images_of_how_far_off_each_is(seed: int) -> None:
    pred, target, valid = make_case(seed)
    offs = [
        abs(float(np.mean(np.log(p[v].numpy()) - np.log(t[v].numpy()))))
        for p, t, v in zip(pred, target, valid, strict=True)
    ]
    assert float(image_scale_loss(pred, target, valid)) == pytest.approx(np.mean(offs))


@given(factors=st.lists(st.floats(0.3, 3.0), min_size=3, max_size=3))
def test_maps_that_are_right_but_for_their_scales_are_off_by_the_logarithms_of_these(factors: list[float]) -> None:
    _, target, valid = make_case(0)
    valid[:, 0, 0, 0] = True
    pred = target * torch.tensor(factors)[:, None, None, None]
    expected = np.mean([abs(math.log(factor)) for factor in factors])
    assert float(image_scale_loss(pred, target, valid)) == pytest.approx(expected, abs=1e-6)


def test_an_image_without_truth_does_not_count() -> None:
    pred, target, valid = make_case(1)
    valid[1] = False
    some = image_scale_loss(pred[[0, 2]], target[[0, 2]], valid[[0, 2]])
    torch.testing.assert_close(image_scale_loss(pred, torch.where(valid, target, math.nan), valid), some)
    assert float(image_scale_loss(pred, target, torch.zeros_like(valid))) == 0


def test_gradients_are_right_and_finite() -> None:
    pred, target, valid = make_case(2)
    pred.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: image_scale_loss(x, target, valid), pred)
    term = ImageScale()(pred, target, torch.zeros(3, 3, 4, 5), valid)
    assert list(term.terms) == ["image_scale"]
    assert term.total.item() == pytest.approx(image_scale_loss(pred, target, valid).item(), rel=1e-6)
