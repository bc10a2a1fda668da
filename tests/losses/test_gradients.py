from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from hudepth.base.errors import ConfigError
from hudepth.losses.gradients import GradientMatching, gradient_matching_loss


def make_case(
    seed: int = 0, *, dtype: torch.dtype = torch.float64, size: tuple[int, int] = (9, 7)
) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    pred, target, chance = torch.rand(3, 2, 1, *size, generator=generator, dtype=torch.float64)
    valid = chance > 0.3
    return (0.05 + 0.95 * pred).to(dtype), torch.where(valid, 0.05 + 0.95 * target, 0.0).to(dtype), valid


def oracle(pred: Tensor, target: Tensor, valid: Tensor, *, scales: int) -> float:
    """The published sum, pixel by pixel in plain Python."""
    p, t, v = (x[:, 0].tolist() for x in (pred.double(), target.double(), valid))
    batch, height, width = len(p), len(p[0]), len(p[0][0])

    def ratio(i: int, y: int, x: int) -> float:
        return math.log(max(p[i][y][x], 1e-3)) - math.log(max(t[i][y][x], 1e-3))

    total = 0.0
    for k in range(scales):
        step = 2**k
        for dy, dx in ((0, step), (step, 0)):
            found = [
                abs(ratio(i, y + dy, x + dx) - ratio(i, y, x))
                for i in range(batch)
                for y in range(0, height - dy, step)
                for x in range(0, width - dx, step)
                if v[i][y][x] and v[i][y + dy][x + dx]
            ]
            total += sum(found) / max(1, len(found))
    return total


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@given(seed=st.integers(0, 1000), scales=st.integers(1, 5), height=st.integers(1, 9), width=st.integers(1, 9))
def test_agrees_with_the_formula(dtype: torch.dtype, seed: int, scales: int, height: int, width: int) -> None:
    """At any size, also where a coarse scale has but one pixel left and counts nothing."""
    pred, target, valid = make_case(seed, dtype=dtype, size=(height, width))
    pred[0, 0, 0, 0] = 0  # below what a logarithm may see
    loss = gradient_matching_loss(pred, target, valid, scales=scales)
    exact = oracle(pred, target, valid, scales=scales)
    assert loss.item() == pytest.approx(exact, rel=1e-5 if dtype == torch.float32 else 1e-12, abs=1e-6)


@given(seed=st.integers(0, 1000), scale=st.floats(0.1, 10.0))
def test_it_is_blind_to_a_factor_of_an_image(seed: int, scale: float) -> None:
    pred, target, valid = make_case(seed)
    factors = torch.tensor([scale, 1.0], dtype=torch.float64).reshape(2, 1, 1, 1)
    losses = [gradient_matching_loss(p, target, valid).item() for p in (pred, factors * pred)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-9)
    assert gradient_matching_loss(factors * target.clamp_min(0.05), target.clamp_min(0.05), valid) < 1e-12


def test_an_edge_counts_whether_it_is_missing_blurred_or_made_up() -> None:
    """One step from 0.2 to 0.8 in the middle of 4 x 8 pixels, by hand: at scale 1, 4 of 28 pairs see it."""
    flat = torch.full((1, 1, 4, 8), 0.2, dtype=torch.float64)
    edge = flat.clone()
    edge[..., 4:] = 0.8
    valid = torch.ones_like(flat, dtype=torch.bool)
    for pred, target in ((flat, edge), (edge, flat)):
        loss = gradient_matching_loss(pred, target, valid, scales=1)
        assert loss.item() == pytest.approx(math.log(4) / 7)
        loss = gradient_matching_loss(pred, target, valid, scales=3)
        assert loss.item() == pytest.approx(math.log(4) * (1 / 7 + 1 / 3 + 1))
    blurred = edge.clone()
    blurred[..., 4] = 0.4  # up by 2 and 2 where the truth goes up by 4 and 1
    assert gradient_matching_loss(blurred, edge, valid, scales=1).item() == pytest.approx(2 * math.log(2) / 7)


def test_a_difference_needs_both_its_pixels() -> None:
    pred = torch.tensor([[[[0.1, 0.9, 0.1, 0.2]]]], dtype=torch.float64)
    target = torch.full_like(pred, 0.5)
    valid = torch.tensor([[[[True, False, True, True]]]])
    assert gradient_matching_loss(pred, target, valid, scales=1).item() == pytest.approx(math.log(2))


def test_gradient_agrees_with_finite_differences() -> None:
    pred, target, valid = make_case(size=(4, 4))
    pred.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: gradient_matching_loss(p, target, valid), (pred,))


@given(seed=st.integers(0, 1000), junk=st.sampled_from([math.nan, math.inf, -math.inf, -1.0]))
def test_invalid_truth_changes_nothing(seed: int, junk: float) -> None:
    pred, target, valid = make_case(seed, dtype=torch.float32)
    results = []
    for truth in (target, torch.where(valid, target, junk)):
        leaf = pred.clone().requires_grad_()
        total = gradient_matching_loss(leaf, truth, valid)
        results.append((total.detach(), *torch.autograd.grad(total, leaf)))
    assert results[0][0].equal(results[1][0])
    assert results[0][1].equal(results[1][1])


@pytest.mark.parametrize("variant", ["identity", "nothing valid", "prediction 0", "truth 0"])
def test_value_and_gradient_stay_finite(variant: str) -> None:
    pred, target, valid = make_case(dtype=torch.float32)
    if variant == "identity":
        pred = target.clone()
    elif variant == "nothing valid":
        valid = torch.zeros_like(valid)
    elif variant == "prediction 0":
        pred = torch.zeros_like(pred)
    else:
        target = torch.zeros_like(target)
    total = gradient_matching_loss(pred.requires_grad_(), target, valid)
    (gradient,) = torch.autograd.grad(total, pred)
    assert total.isfinite()
    assert gradient.isfinite().all()
    if variant in ("identity", "nothing valid"):
        assert total.item() == 0.0


@pytest.mark.parametrize("scales", [1, 4])
def test_the_module_is_the_function(scales: int) -> None:
    pred, target, valid = make_case()
    loss: Any = GradientMatching(scales=scales)
    total, terms = loss(pred, target, torch.zeros(2, 3, 9, 7), valid)
    assert total.equal(gradient_matching_loss(pred, target, valid, scales=scales))
    assert list(terms) == ["gradient"]
    assert terms["gradient"].equal(total)


def test_half_precision_under_autocast_costs_only_the_rounding_of_the_input() -> None:
    pred, target, valid = make_case(dtype=torch.float32, size=(64, 64))
    rounded, image = pred.bfloat16(), torch.zeros(2, 3, 64, 64)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        total = GradientMatching()(rounded, target, image, valid).total
    assert total.dtype == torch.float32
    assert total.equal(gradient_matching_loss(rounded.float(), target, valid))


@pytest.mark.parametrize("scales", [0, -2])
def test_no_scale_says_what_to_do(scales: int) -> None:
    with pytest.raises(ConfigError) as caught:
        GradientMatching(scales=scales)
    assert str(caught.value).startswith(f"loss.scales: {scales} ")
