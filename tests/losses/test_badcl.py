from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from hudepth.base.errors import ConfigError
from hudepth.base.normalise import normalise_image
from hudepth.losses import BADCL
from hudepth.losses.badcl import CHOICES, boundary_weight, forward_difference, scaling_factor, scaling_loss

VARIANTS = [dict(zip(CHOICES, values, strict=True)) for values in itertools.product(*CHOICES.values())]


class Case(NamedTuple):
    pred: Tensor
    target: Tensor
    image: Tensor
    valid: Tensor

    def loss(self, **options: Any) -> Any:
        return BADCL(**options)(*self)


def make_case(*, seed: int = 0, batch: int = 2, height: int = 5, width: int = 6, dtype: torch.dtype) -> Case:
    generator = torch.Generator().manual_seed(seed)

    def uniform(channels: int) -> Tensor:
        return torch.rand(batch, channels, height, width, generator=generator, dtype=torch.float64)

    valid = uniform(1) > 0.3
    return Case(
        uniform(1).to(dtype),
        torch.where(valid, uniform(1), 0.0).to(dtype),
        normalise_image(uniform(3)).to(dtype),
        valid,
    )


def oracle(case: Case, options: dict[str, str], eps: float = 1e-8) -> dict[str, float]:
    """The paper's formulas, pixel by pixel in float64."""
    pred, target = case.pred[:, 0].double().numpy(), case.target[:, 0].double().numpy()
    image, valid = case.image.double().numpy().copy(), case.valid[:, 0].numpy()
    if options["image_space"] == "unit":
        image = image * np.array([0.229, 0.224, 0.225])[:, None, None] + np.array([0.485, 0.456, 0.406])[:, None, None]
    if options["image_channels"] == "grey":
        image = (0.299 * image[:, 0] + 0.587 * image[:, 1] + 0.114 * image[:, 2])[:, None]
    scales = scale_oracle(pred, target, valid, options["scale_per"], eps)
    sums = {"boundary": 0.0, "smoothness": 0.0, "scaling": 0.0}
    batch, height, width = pred.shape
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        right, below = min(x + 1, width - 1), min(y + 1, height - 1)
        ix = [float(channel[y, right] - channel[y, x]) for channel in image[b]]
        iy = [float(channel[below, x] - channel[y, x]) for channel in image[b]]
        sums["smoothness"] += abs(pred[b, y, right] - pred[b, y, x]) * math.exp(-np.mean(np.abs(ix)))
        sums["smoothness"] += abs(pred[b, below, x] - pred[b, y, x]) * math.exp(-np.mean(np.abs(iy)))
        if not valid[b, y, x]:
            continue
        edge = np.mean([math.sqrt(gx**2 + gy**2) for gx, gy in zip(ix, iy, strict=True)])
        sign = 1 if options["boundary_sign"] == "plus" else -1
        sums["boundary"] += math.exp(sign * edge) * abs(pred[b, y, x] - target[b, y, x])
        if options["scale_mode"] == "weight":
            sums["scaling"] += scales[b] * abs(pred[b, y, x] - target[b, y, x])
        else:
            sums["scaling"] += abs(scales[b] * pred[b, y, x] - target[b, y, x])
    return {name: total / (pred.size if name == "smoothness" else valid.sum()) for name, total in sums.items()}


def scale_oracle(pred: NDArray[Any], target: NDArray[Any], valid: NDArray[Any], per: str, eps: float) -> list[float]:
    if per == "batch":
        return [target[valid].sum() / (pred[valid].sum() + eps)] * len(pred)
    return [t[v].sum() / (p[v].sum() + eps) for p, t, v in zip(pred, target, valid, strict=True)]


@pytest.mark.parametrize("options", VARIANTS, ids=lambda options: "-".join(options.values()))
def test_every_variant_agrees_with_the_formulas(options: dict[str, Any]) -> None:
    case = make_case(dtype=torch.float32)
    total, terms = case.loss(**options)
    expected = oracle(case, options)
    assert {name: term.item() for name, term in terms.items()} == pytest.approx(expected, rel=1e-6)
    weighted = 3.0 * expected["boundary"] + 1.2 * expected["smoothness"] + 1.0 * expected["scaling"]
    assert total.item() == pytest.approx(weighted, rel=1e-6)


def test_defaults_are_the_first_choices() -> None:
    case = make_case(dtype=torch.float32)
    first = {option: values[0] for option, values in CHOICES.items()}
    assert case.loss().total.equal(case.loss(**first).total)


@given(seed=st.integers(0, 1000), batch=st.integers(1, 3), height=st.integers(1, 7), width=st.integers(1, 7))
def test_any_shape_agrees_with_the_formulas(seed: int, batch: int, height: int, width: int) -> None:
    case = make_case(seed=seed, batch=batch, height=height, width=width, dtype=torch.float64)
    terms = case.loss().terms
    if case.valid.any():
        expected = oracle(case, VARIANTS[0])
        assert {name: term.item() for name, term in terms.items()} == pytest.approx(expected, rel=1e-12)
    else:
        assert terms["boundary"].item() == terms["scaling"].item() == 0.0


FLOWING = [options for options in VARIANTS if options["scale_gradient"] == "flow"]


@pytest.mark.parametrize("options", FLOWING, ids=lambda options: "-".join(options.values()))
def test_gradient_agrees_with_finite_differences(options: dict[str, Any]) -> None:
    case = make_case(height=3, width=3, dtype=torch.float64)
    pred = case.pred.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: BADCL(**options)(p, *case[1:]).total, (pred,))


def test_stopped_gradient_takes_the_scale_as_a_constant() -> None:
    case = make_case(dtype=torch.float64)
    pred = case.pred.requires_grad_()
    loss = scaling_loss(pred, *(case.target, case.valid), gradient="stop")
    (gradient,) = torch.autograd.grad(loss, pred)
    p, t, valid = pred.detach()[:, 0].numpy(), case.target[:, 0].numpy(), case.valid[:, 0].numpy()
    scales = np.array(scale_oracle(p, t, valid, "image", 1e-8))[:, None, None]
    np.testing.assert_allclose(gradient[:, 0].numpy(), scales * np.sign(p - t) * valid / valid.sum(), rtol=1e-9)


def test_forward_difference_is_zero_in_the_last_column_and_row() -> None:
    x = torch.arange(12.0).reshape(1, 1, 3, 4)
    assert forward_difference(x, dim=-1)[0, 0].tolist() == [[1.0, 1.0, 1.0, 0.0]] * 3
    assert forward_difference(x, dim=-2)[0, 0].tolist() == [[4.0] * 4, [4.0] * 4, [0.0] * 4]


def test_boundary_weight_of_a_known_gradient() -> None:
    dx, dy = torch.full((1, 1, 1, 1), 3.0), torch.full((1, 1, 1, 1), 4.0)
    assert boundary_weight(dx, dy).item() == pytest.approx(math.exp(5.0))
    assert boundary_weight(dx, dy, sign="minus").item() == pytest.approx(math.exp(-5.0))


@given(seed=st.integers(0, 1000), scale=st.floats(0.25, 1.0))
def test_align_ignores_the_scale_of_the_prediction(seed: int, scale: float) -> None:
    pred, target, _, valid = make_case(seed=seed, dtype=torch.float64)
    aligned = [scaling_loss(p, target, valid, mode="align").item() for p in (pred, scale * pred)]
    assert aligned[0] == pytest.approx(aligned[1], rel=1e-6)


def test_identity_of_constant_maps_costs_nothing() -> None:
    case = make_case(dtype=torch.float32)
    depth = torch.full_like(case.pred, 0.4)
    terms = BADCL()(depth, depth, case.image, torch.ones_like(case.valid)).terms
    assert [term.item() for term in terms.values()] == [0.0, 0.0, 0.0]


@given(seed=st.integers(0, 1000), junk=st.sampled_from([math.nan, math.inf, -math.inf, 1e30]))
def test_invalid_truth_changes_nothing(seed: int, junk: float) -> None:
    case = make_case(seed=seed, dtype=torch.float32)
    results = []
    for target in (case.target, torch.where(case.valid, case.target, junk)):
        pred = case.pred.clone().requires_grad_()
        total = BADCL()(pred, target, case.image, case.valid).total
        results.append((total.detach(), *torch.autograd.grad(total, pred)))
    assert results[0][0].equal(results[1][0])
    assert results[0][1].equal(results[1][1])


@given(seed=st.integers(0, 1000), order=st.permutations(range(3)))
def test_order_of_the_batch_does_not_matter(seed: int, order: list[int]) -> None:
    case = make_case(seed=seed, batch=3, dtype=torch.float64)
    shuffled = Case(*(tensor[list(order)] for tensor in case))
    assert shuffled.loss().total.item() == pytest.approx(case.loss().total.item(), rel=1e-12)


EXTREMES: dict[str, Callable[[Case], Case]] = {
    "nothing valid": lambda case: case._replace(valid=torch.zeros_like(case.valid)),
    "one image without valid pixels": lambda case: case._replace(
        valid=case.valid & torch.tensor([True, False]).view(2, 1, 1, 1)
    ),
    "prediction 0": lambda case: case._replace(pred=torch.zeros_like(case.pred)),
    "prediction 1": lambda case: case._replace(pred=torch.ones_like(case.pred)),
    "truth 0": lambda case: case._replace(target=torch.zeros_like(case.target)),
    "truth is NaN": lambda case: case._replace(
        target=torch.full_like(case.target, torch.nan), valid=torch.zeros_like(case.valid)
    ),
    "negative prediction": lambda case: case._replace(pred=-case.pred),
    "prediction whose sum cancels": lambda case: case._replace(
        pred=case.pred - case.pred.mean(), valid=torch.ones_like(case.valid)
    ),
    "flat image": lambda case: case._replace(image=torch.zeros_like(case.image)),
    "one row": lambda case: Case(*(tensor[:, :, :1] for tensor in case)),
    "one column": lambda case: Case(*(tensor[..., :1] for tensor in case)),
    "one pixel": lambda case: Case(*(tensor[..., :1, :1] for tensor in case)),
}


@pytest.mark.parametrize("extreme", EXTREMES)
@pytest.mark.parametrize("options", VARIANTS[::5], ids=lambda options: "-".join(options.values()))
def test_value_and_gradient_stay_finite(extreme: str, options: dict[str, Any]) -> None:
    pred, target, image, valid = EXTREMES[extreme](make_case(dtype=torch.float32))
    pred.requires_grad_()
    total = BADCL(**options)(pred, target, image, valid).total
    (gradient,) = torch.autograd.grad(total, pred)
    assert total.isfinite()
    assert gradient.isfinite().all()


@pytest.mark.parametrize("logit", [-1e4, -100.0, -88.0, 0.0, 88.0, 1e4])
def test_extreme_logits_keep_the_gradient_finite(logit: float) -> None:
    case = make_case(dtype=torch.float32)
    logits = torch.full_like(case.pred, logit).requires_grad_()
    total = BADCL()(torch.sigmoid(logits), *case[1:]).total
    (gradient,) = torch.autograd.grad(total, logits)
    assert total.isfinite()
    assert gradient.isfinite().all()


def test_image_receives_no_gradient() -> None:
    case = make_case(dtype=torch.float32)
    image, pred = torch.zeros_like(case.image).requires_grad_(), case.pred.requires_grad_()
    total = BADCL()(pred, case.target, image, case.valid).total
    to_pred, to_image = torch.autograd.grad(total, (pred, image), allow_unused=True)
    assert to_pred.any()
    assert to_image is None


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_under_autocast_costs_only_the_rounding_of_the_input(dtype: torch.dtype) -> None:
    case = make_case(height=64, width=64, dtype=torch.float32)
    rounded = case._replace(pred=case.pred.to(dtype))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        total, terms = rounded.loss()
    expected = case._replace(pred=rounded.pred.float()).loss()
    assert total.dtype == torch.float32
    assert total.equal(expected.total)
    assert all(terms[name].equal(expected.terms[name]) for name in terms)


def test_a_weight_of_zero_leaves_the_term_out_and_the_others_alone() -> None:
    case = make_case(dtype=torch.float32)
    full = case.loss()
    for absent in ("boundary", "smoothness", "scaling"):
        total, terms = case.loss(**{absent: 0})
        weights = {"boundary": 3.0, "smoothness": 1.2, "scaling": 1.0}
        assert set(terms) == set(full.terms) - {absent}
        assert all(terms[name].equal(full.terms[name]) for name in terms)
        assert total.item() == pytest.approx(sum(weights[name] * terms[name].item() for name in terms), rel=1e-6)


def test_scaling_alone_does_not_look_at_the_image() -> None:
    case = make_case(dtype=torch.float32)
    blind = case._replace(image=torch.full_like(case.image, torch.nan))
    assert blind.loss(boundary=0, smoothness=0).total.isfinite()


def test_scaling_factor_is_one_per_image_or_per_batch() -> None:
    pred, target, _, valid = make_case(dtype=torch.float32)
    assert scaling_factor(pred, target, valid).shape == (2, 1, 1, 1)
    assert scaling_factor(pred, target, valid, per="batch").shape == (1, 1, 1, 1)


@pytest.mark.parametrize("value", [-1.0, -1e-8, 0.0])
def test_scaling_factor_takes_a_negative_sum_for_zero(value: float) -> None:
    pred, one = torch.full((1, 1, 1, 1), value), torch.ones(1, 1, 1, 1)
    assert scaling_factor(pred, one, one.bool()).item() == pytest.approx(1e8)


def test_a_copy_computes_the_same() -> None:
    case, loss = make_case(dtype=torch.float32), BADCL(scale_mode="align", scale_per="batch")
    assert copy.deepcopy(loss)(*case).total.equal(loss(*case).total)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"boundary_sign": "pluss"},
            "loss.boundary_sign: no choice 'pluss'. Use 'plus' or 'minus'. Did you mean 'plus'?",
        ),
        (
            {"image_space": "normalized"},
            "loss.image_space: no choice 'normalized'. Use 'unit' or 'normalised'. Did you mean 'normalised'?",
        ),
        (
            {"image_channels": "gray"},
            "loss.image_channels: no choice 'gray'. Use 'grey' or 'colour'. Did you mean 'grey'?",
        ),
        ({"scale_per": "pixel"}, "loss.scale_per: no choice 'pixel'. Use 'image' or 'batch'."),
        (
            {"scale_mode": "weigth"},
            "loss.scale_mode: no choice 'weigth'. Use 'weight' or 'align'. Did you mean 'weight'?",
        ),
        ({"scale_gradient": "no"}, "loss.scale_gradient: no choice 'no'. Use 'flow' or 'stop'."),
        (
            {"boundary": -1.0},
            "loss.boundary: weight -1.0. Use a finite number of at least 0 (0 leaves the term out).",
        ),
        (
            {"scaling": math.nan},
            "loss.scaling: weight nan. Use a finite number of at least 0 (0 leaves the term out).",
        ),
        (
            {"boundary": 0, "smoothness": 0, "scaling": 0},
            "loss: boundary, smoothness, scaling all have weight 0. Give at least one a positive weight.",
        ),
        ({"eps": 0.0}, "loss.eps: 0.0 is too small for float32. Use at least 1e-12."),
    ],
)
def test_bad_options_say_what_to_do(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        BADCL(**options)
    assert str(caught.value).split(":")[0] == message.split(":")[0]
