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
from hudepth.losses.distillation import KINDS, Distillation, affine_invariant_loss, normalised_by_mean


def make_case(
    seed: int = 0, *, dtype: torch.dtype = torch.float64, size: tuple[int, int] = (5, 6)
) -> tuple[Tensor, Tensor]:
    """Return a prediction and a teacher's depths, 0 where it said nothing."""
    generator = torch.Generator().manual_seed(seed)
    pred, teacher, chance = torch.rand(3, 2, 1, *size, generator=generator, dtype=torch.float64)
    return (0.05 + pred).to(dtype), torch.where(chance > 0.3, 0.05 + teacher, 0.0).to(dtype)


def standard(x: NDArray[Any]) -> NDArray[Any]:
    centred = x - x.mean()
    result: NDArray[Any] = centred / (np.abs(centred).mean() + 1e-6)
    return result


def oracle(kind: str, pred: Tensor, teacher: Tensor) -> float:
    """The mean over all pixels at which the teacher said something, image by image in numpy."""
    errors = []
    for p, t in zip(pred.double().numpy(), teacher.double().numpy(), strict=True):
        p, t = p[t > 0], t[t > 0]
        if kind == "metric":
            errors.append(np.abs(np.log(np.maximum(p, 1e-3)) - np.log(np.maximum(t, 1e-3))))
        elif len(t):
            p = 1 / np.maximum(p, 1e-3) if kind == "affine_inverse" else p
            errors.append(np.abs(standard(p) - standard(t)))
    return float(np.concatenate(errors).mean())


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 1000))
def test_agrees_with_the_formula(kind: str, seed: int) -> None:
    pred, teacher = make_case(seed)
    pred[0, 0, 0, :2] = torch.tensor([0.0, 1e-4])
    teacher[0, 0, 0, :2] = 0.5
    assert Distillation(kind=kind)(pred, teacher).item() == pytest.approx(oracle(kind, pred, teacher), rel=1e-9)
    single = Distillation(kind=kind)(pred.float(), teacher.float())
    assert single.dtype == torch.float32
    assert single.item() == pytest.approx(oracle(kind, pred.float(), teacher.float()), rel=1e-4)


@given(seed=st.integers(0, 1000))
def test_each_image_is_brought_to_mean_0_and_deviation_1(seed: int) -> None:
    pred, teacher = make_case(seed)
    valid = teacher > 0
    found = normalised_by_mean(7 * pred - 3, valid)
    assert not found[~valid].any()
    for x, mask in zip(found, valid, strict=True):
        assert x[mask].mean().item() == pytest.approx(0, abs=1e-9)
        assert x[mask].abs().mean().item() == pytest.approx(1, rel=1e-5)


@given(seed=st.integers(0, 1000), scale=st.floats(0.5, 100.0), shift=st.floats(0, 100.0))
def test_affine_kinds_are_blind_to_the_scale_and_shift_of_each_image(seed: int, scale: float, shift: float) -> None:
    pred, teacher = make_case(seed)
    factor = torch.tensor([scale, 1.0], dtype=torch.float64).reshape(2, 1, 1, 1)
    moved = torch.where(teacher > 0, factor * teacher + shift, 0.0)
    for kind in ("affine_depth", "affine_inverse"):
        losses = [Distillation(kind=kind)(pred, t).item() for t in (teacher, moved)]
        assert losses[0] == pytest.approx(losses[1], rel=1e-4)
        assert losses[0] > 0.1
    for kind, depth in (("affine_depth", pred), ("affine_inverse", 1 / pred)):  # a teacher that is right
        assert Distillation(kind=kind)(pred, factor * depth + shift) < 1e-4
    assert Distillation(kind="affine_depth")(pred, 1 / pred) > 0.1  # but not of the other kind


def test_the_metric_kind_is_not_blind_to_scale() -> None:
    pred, _ = make_case()
    assert Distillation(kind="metric")(2 * pred, pred).item() == pytest.approx(math.log(2))
    assert Distillation(kind="metric")(pred, pred).item() == 0


def test_teachers_may_go_beyond_the_unit() -> None:
    pred = torch.full((1, 1, 2, 2), 0.5)
    assert Distillation()(pred, torch.full_like(pred, 2.0)).item() == pytest.approx(math.log(4))


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_agrees_with_finite_differences(kind: str) -> None:
    pred, teacher = make_case(size=(3, 3))
    assert torch.autograd.gradcheck(lambda p: Distillation(kind=kind)(p, teacher), (pred.requires_grad_(),))


@pytest.mark.parametrize("kind", KINDS)
def test_where_the_teacher_says_nothing_nothing_is_learnt(kind: str) -> None:
    pred, teacher = make_case()
    wrong = torch.where(teacher > 0, pred, math.inf).requires_grad_()
    loss = Distillation(kind=kind)(wrong, torch.where(teacher > 0, teacher, -1.0))
    assert loss.item() == pytest.approx(Distillation(kind=kind)(pred, teacher).item(), rel=1e-12)
    (gradient,) = torch.autograd.grad(loss, wrong)
    assert not gradient[teacher <= 0].any()
    assert gradient[teacher > 0].any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("variant", ["identity", "nothing said", "one pixel", "flat", "flat teacher", "prediction 0"])
def test_value_and_gradient_stay_finite(kind: str, variant: str) -> None:
    pred, teacher = make_case(dtype=torch.float32)
    if variant == "identity":
        teacher = pred.clone()
    elif variant == "nothing said":
        teacher = torch.zeros_like(teacher)
    elif variant == "one pixel":
        teacher = torch.zeros_like(teacher)
        teacher[0, 0, 0, 0] = 0.5
    elif variant == "flat":
        pred = torch.full_like(pred, 0.3)
    elif variant == "flat teacher":
        teacher = torch.full_like(teacher, 0.3)
    else:
        pred = torch.zeros_like(pred)
    loss = Distillation(kind=kind)(pred.requires_grad_(), teacher)
    (gradient,) = torch.autograd.grad(loss, pred)
    assert loss.isfinite()
    assert gradient.isfinite().all()
    if variant == "nothing said":
        assert loss.item() == 0
        assert not gradient.any()


@pytest.mark.parametrize("kind", KINDS)
def test_half_precision_under_autocast_costs_only_the_rounding_of_the_input(kind: str) -> None:
    pred, teacher = make_case(dtype=torch.float32, size=(64, 64))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = Distillation(kind=kind)(pred.bfloat16(), teacher)
    assert loss.dtype == torch.float32
    assert loss.equal(Distillation(kind=kind)(pred.bfloat16().float(), teacher))


def test_the_weight_is_kept_for_who_adds_the_losses() -> None:
    pred, teacher = make_case()
    heavy = Distillation(weight=5.0)
    assert heavy.weight == 5.0
    assert heavy(pred, teacher).equal(Distillation()(pred, teacher))


def test_the_affine_loss_counts_pixels_not_images() -> None:
    """Of images with 4 and 1 valid pixels, the larger weighs four times as much."""
    pred = torch.tensor([[0.0, 1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0]], dtype=torch.float64).reshape(2, 1, 2, 2)
    teacher = torch.tensor([[3.0, 2.0, 1.0, 0.0], [1.0, 2.0, 3.0, 4.0]], dtype=torch.float64).reshape(2, 1, 2, 2)
    valid = torch.ones_like(pred, dtype=torch.bool)
    valid[1, 0] = torch.tensor([[True, False], [False, False]])
    # of 0, 1, 2, 3 the mean is 1.5 and the deviation 1: the differences are 3, 1, 1, 3
    assert affine_invariant_loss(pred, teacher, valid).item() == pytest.approx(8 / 5, rel=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"kind": "affine"},
            "distill.kind: no 'affine'. Did you mean 'affine_depth'? Pass one of metric, affine_depth, affine_inverse.",
        ),
        ({"kind": "x"}, "distill.kind: no 'x'. Pass one of metric, affine_depth, affine_inverse."),
        ({"weight": 0.0}, "distill.weight: 0.0 is not positive. Pass distill=none to learn without a teacher."),
        ({"weight": -1.0}, "distill.weight: -1.0 is not positive. Pass distill=none to learn without a teacher."),
        ({"weight": math.inf}, "distill.weight: inf is not positive. Pass distill=none to learn without a teacher."),
        ({"weight": math.nan}, "distill.weight: nan is not positive. Pass distill=none to learn without a teacher."),
    ],
)
def test_bad_options_say_what_to_do(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Distillation(**options)
    assert str(caught.value).split(":")[0] == message.split(":")[0]
