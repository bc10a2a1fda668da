from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.base.types import LossTerms
from hudepth.losses import BADCL, L1, SILog
from hudepth.losses.gradients import GradientMatching
from hudepth.losses.mixture import Mixture


class Part(nn.Module):
    """A loss with a factor that could be learnt, and two terms."""

    def __init__(self, name: str, factor: float) -> None:
        super().__init__()
        self.name = name
        self.factor = nn.Parameter(torch.tensor(factor, dtype=torch.float64))

    def forward(self, pred: Tensor, target: Tensor, image: Tensor, valid: Tensor) -> LossTerms:
        total = self.factor * torch.where(valid, pred - target, 0.0).sum() + image.mean()
        return LossTerms(total, {f"{self.name}_a": total + 1, f"{self.name}_b": total + 2})


class Forbidden(nn.Module):
    def forward(self, *_: Tensor) -> LossTerms:
        raise AssertionError("a loss of weight 0 is not computed")


def make_case() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    pred, target, chance = torch.rand(3, 2, 1, 8, 8, generator=generator, dtype=torch.float64)
    image = torch.rand(2, 3, 8, 8, generator=generator, dtype=torch.float64)
    return pred, target.clamp_min(0.1), image, chance > 0.2


@given(weights=st.lists(st.floats(0, 10), min_size=3, max_size=3))
def test_the_total_is_the_weighted_sum_and_terms_stand_side_by_side(weights: list[float]) -> None:
    parts = {name: Part(name, factor) for name, factor in (("one", 1.0), ("two", -3.0), ("three", 0.5))}
    named = dict(zip(parts, weights, strict=True))
    case = make_case()
    assume(any(weights))
    total, terms = Mixture(losses=parts, weights=named)(*case)
    expected = sum(weight * parts[name](*case).total.item() for name, weight in named.items())
    assert total.item() == pytest.approx(expected, rel=1e-12, abs=1e-12)
    kept = [name for name in parts if named[name]]
    assert set(terms) == {f"{name}_{letter}" for name in kept for letter in "ab"}
    for name in kept:
        assert terms[f"{name}_b"].equal(parts[name](*case).terms[f"{name}_b"])  # before its weight


def test_the_losses_of_this_package_mix() -> None:
    pred, target, image, valid = make_case()
    losses = {"silog": SILog(), "gradient": GradientMatching(), "l1": L1(), "badcl": BADCL()}
    weights = {"silog": 1.0, "gradient": 0.5, "l1": 2.0, "badcl": 0.1}
    leaf = pred.clone().requires_grad_()
    total, terms = Mixture(losses=losses, weights=weights)(leaf, target, image, valid)
    assert {"silog", "gradient", "l1", *BADCL().weights} == set(terms)
    (gradient,) = torch.autograd.grad(total, leaf)
    expected = torch.zeros_like(pred)
    for name, loss in losses.items():
        leaf = pred.clone().requires_grad_()
        expected += weights[name] * torch.autograd.grad(loss(leaf, target, image, valid).total, leaf)[0]
    torch.testing.assert_close(gradient, expected)


def test_a_loss_of_weight_0_is_not_computed() -> None:
    losses = {"one": Part("one", 1.0), "off": Forbidden()}
    mixture = Mixture(losses=losses, weights={"off": 0.0, "one": 2})
    total, terms = mixture(*make_case())
    assert total.item() == pytest.approx(2 * losses["one"](*make_case()).total.item())
    assert set(terms) == {"one_a", "one_b"}
    assert dict(mixture.named_parameters()).keys() == {"losses.one.factor"}


def test_a_mixture_moves_its_parts_to_another_precision() -> None:
    part = Part("one", 1.0)
    Mixture(losses={"one": part}, weights={"one": 1.0}).float()
    assert part.factor.dtype == torch.float32


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"one": 1.0, "two": 1.0, "three": 1.0}, "loss.weights.three: no loss has this name; there are one, two."),
        ({"one": 1.0}, "loss.weights: none for 'two'. Pass loss.weights.two=1, or 0 to leave it out."),
        ({"one": -1.0, "two": 1.0}, "loss.weights.one: -1.0 is not a number of at least 0."),
        ({"one": 1.0, "two": math.nan}, "loss.weights.two: nan is not a number of at least 0."),
        ({"one": 1.0, "two": math.inf}, "loss.weights.two: inf is not a number of at least 0."),
        ({"one": 0.0, "two": 0}, "loss.weights: one, two all have weight 0. Give one a positive weight."),
    ],
)
def test_bad_weights_say_what_to_do(weights: Mapping[str, float], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Mixture(losses={"one": Part("one", 1.0), "two": Part("two", 1.0)}, weights=weights)
    assert str(caught.value).split(":")[0] == message.split(":")[0]
