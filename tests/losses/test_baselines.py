from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.losses import L1, L2, BerHu, SILog
from hudepth.losses.baselines import berhu_loss, silog_loss

LOSSES: dict[str, Callable[..., nn.Module]] = {"l1": L1, "l2": L2, "berhu": BerHu, "silog": SILog}


def make_case(seed: int = 0, *, dtype: torch.dtype = torch.float64, side: int = 5) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    pred, target, chance = torch.rand(3, 2, 1, side, side, generator=generator, dtype=torch.float64)
    valid = chance > 0.3
    valid[0, 0, 0, 0] = True
    return pred.to(dtype), torch.where(valid, 0.05 + 0.95 * target, 0.0).to(dtype), valid


def call(loss: nn.Module, pred: Tensor, target: Tensor, valid: Tensor) -> Any:
    return loss(pred, target, torch.zeros(len(pred), 3, *pred.shape[-2:]), valid)


def oracle(name: str, pred: NDArray[Any], target: NDArray[Any]) -> float:
    """Each published formula over a flat list of valid pixels, in float64."""
    error = np.abs(pred - target)
    if name == "l1":
        return float(sum(error) / len(error))
    if name == "l2":
        return float(sum(error**2) / len(error))
    if name == "berhu":
        c = max(error) / 5
        return float(np.mean([e if e <= c else (e * e + c * c) / (2 * c) for e in error]))
    g = [math.log(max(p, 1e-3)) - math.log(max(t, 1e-3)) for p, t in zip(pred, target, strict=True)]
    return 10 * math.sqrt(sum(x * x for x in g) / len(g) - 0.85 * (sum(g) / len(g)) ** 2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", LOSSES)
@given(seed=st.integers(0, 1000))
def test_agrees_with_the_formula(name: str, dtype: torch.dtype, seed: int) -> None:
    pred, target, valid = make_case(seed, dtype=dtype)
    total, terms = call(LOSSES[name](), pred, target, valid)
    mask = valid.numpy()
    expected = oracle(name, pred.double().numpy()[mask], target.double().numpy()[mask])
    assert total.item() == pytest.approx(expected, rel=1e-6)
    assert list(terms) == [name]
    assert terms[name].equal(total)


@pytest.mark.parametrize("name", ["l1", "l2", "silog"])
def test_gradient_agrees_with_finite_differences(name: str) -> None:
    pred, target, valid = make_case(side=3)
    loss = LOSSES[name]()
    pred = pred.clamp_min(0.01).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: call(loss, p, target, valid).total, (pred,))


def test_berhu_gradient_takes_the_threshold_as_a_constant() -> None:
    pred, target, valid = make_case()
    (gradient,) = torch.autograd.grad(berhu_loss(pred.requires_grad_(), target, valid), pred)
    error = (pred.detach() - target).numpy() * valid.numpy()
    c = np.abs(error).max() / 5
    slope = np.where(np.abs(error) <= c, np.sign(error), error / c)
    np.testing.assert_allclose(gradient.numpy(), slope / valid.sum().item(), rtol=1e-12)


@given(seed=st.integers(0, 1000), scale=st.floats(0.2, 5.0))
def test_silog_with_full_focus_forgives_any_scale(seed: int, scale: float) -> None:
    pred, target, valid = make_case(seed)
    pred = pred.clamp_min(0.01)
    losses = [silog_loss(p, target, valid, variance_focus=1.0).item() for p in (pred, scale * pred)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-9)


def test_silog_of_a_scaled_truth_is_the_rest_of_the_squared_mean() -> None:
    target = torch.full((1, 1, 4, 4), 0.2, dtype=torch.float64)
    loss = silog_loss(2 * target, target, torch.ones_like(target, dtype=torch.bool))
    assert loss.item() == pytest.approx(10 * math.log(2) * math.sqrt(0.15))


@pytest.mark.parametrize("name", LOSSES)
@given(seed=st.integers(0, 1000), junk=st.sampled_from([math.nan, math.inf, -math.inf, -1.0]))
def test_invalid_truth_changes_nothing(name: str, seed: int, junk: float) -> None:
    pred, target, valid = make_case(seed, dtype=torch.float32)
    results = []
    for truth in (target, torch.where(valid, target, junk)):
        leaf = pred.clone().requires_grad_()
        total = call(LOSSES[name](), leaf, truth, valid).total
        results.append((total.detach(), *torch.autograd.grad(total, leaf)))
    assert results[0][0].equal(results[1][0])
    assert results[0][1].equal(results[1][1])


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("variant", ["identity", "nothing valid", "prediction 0", "truth 0", "nearly equal"])
def test_value_and_gradient_stay_finite(name: str, variant: str) -> None:
    pred, target, valid = make_case(dtype=torch.float32)
    if variant == "identity":
        pred = target.clone()
    elif variant == "nothing valid":
        valid = torch.zeros_like(valid)
    elif variant == "prediction 0":
        pred = torch.zeros_like(pred)
    elif variant == "truth 0":
        target = torch.zeros_like(target)
    else:
        pred = target.nextafter(torch.ones(()))
    total = call(LOSSES[name](), pred.requires_grad_(), target, valid).total
    (gradient,) = torch.autograd.grad(total, pred)
    assert total.isfinite()
    assert gradient.isfinite().all()
    if variant in ("identity", "nothing valid"):
        assert total.item() == 0.0
        assert not gradient.any()


@pytest.mark.parametrize("name", LOSSES)
def test_half_precision_under_autocast_costs_only_the_rounding_of_the_input(name: str) -> None:
    pred, target, valid = make_case(dtype=torch.float32, side=64)
    rounded = pred.bfloat16()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        total = call(LOSSES[name](), rounded, target, valid).total
    assert total.dtype == torch.float32
    assert total.equal(call(LOSSES[name](), rounded.float(), target, valid).total)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: BerHu(threshold=0.0), "loss.threshold: 0.0 is not in (0, 1]. The usual value is 0.2."),
        (
            lambda: SILog(variance_focus=1.5),
            "loss.variance_focus: 1.5 is not in [0, 1]. The usual value is 0.85.",
        ),
        (lambda: SILog(factor=-10.0), "loss.factor: -10.0 is not positive. The usual value is 10."),
    ],
)
def test_bad_options_say_what_to_do(build: Callable[[], nn.Module], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        build()
    assert str(caught.value).split(":")[0] == message.split(":")[0]
