from __future__ import annotations

import numpy as np
import pytest
import torch

from hudepth.base.masked import full_precision, masked_mean, masked_sum


def test_sum_and_mean_agree_with_numpy() -> None:
    rng = np.random.default_rng(0)
    x, valid = rng.normal(size=(3, 1, 4, 5)), rng.random((3, 1, 4, 5)) > 0.4
    per_image = [image[mask].sum() for image, mask in zip(x, valid, strict=True)]
    tensors = torch.from_numpy(x), torch.from_numpy(valid)
    assert masked_sum(*tensors).item() == pytest.approx(x[valid].sum())
    assert masked_sum(*tensors, dim=(1, 2, 3)).shape == (3, 1, 1, 1)
    assert masked_sum(*tensors, dim=(1, 2, 3)).flatten().tolist() == pytest.approx(per_image)
    assert masked_mean(*tensors).item() == pytest.approx(x[valid].mean())


def test_invalid_values_reach_neither_value_nor_gradient() -> None:
    x = torch.tensor([1.0, torch.nan, torch.inf, 3.0], requires_grad=True)
    mean = masked_mean(x, torch.tensor([True, False, False, True]))
    (gradient,) = torch.autograd.grad(mean, x)
    assert mean.item() == 2.0
    assert gradient.tolist() == [0.5, 0.0, 0.0, 0.5]


def test_mean_of_nothing_is_zero_with_zero_gradient() -> None:
    x = torch.ones(4, requires_grad=True)
    mean = masked_mean(x, torch.zeros(4, dtype=torch.bool))
    (gradient,) = torch.autograd.grad(mean, x)
    assert mean.item() == 0.0
    assert gradient.tolist() == [0.0] * 4


@pytest.mark.parametrize(
    ("dtype", "expected"),
    [
        (torch.float16, torch.float32),
        (torch.bfloat16, torch.float32),
        (torch.float32, torch.float32),
        (torch.float64, torch.float64),
    ],
)
def test_full_precision_raises_half_and_keeps_double(dtype: torch.dtype, expected: torch.dtype) -> None:
    assert full_precision(torch.zeros(1, dtype=dtype)).dtype == expected
