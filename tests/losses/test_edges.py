from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from hudepth.base.errors import ConfigError
from hudepth.losses.edges import EdgeOverlap, edge_overlap_loss
from hudepth.metrics.boundary import edge_scores


def make_case(seed: int, *, images: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    pred, target, chance = torch.rand(3, images, 1, 9, 11, generator=generator, dtype=torch.float64) / 5
    return pred, target, chance > 0.01


def step(height: float, *, blurred: int = 0) -> Tensor:
    """Return a map that rises by ``height`` in its middle, over 1 + ``blurred`` columns."""
    rise = np.clip((np.arange(16) - 7.5) / (1 + blurred) + 0.5, 0, 1)
    return torch.tensor(0.2 + height * np.tile(rise, (12, 1)))[None, None]


def slopes(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.hypot(*(ndimage.sobel(x, axis=axis) for axis in (0, 1)))[1:-1, 1:-1]


@given(seed=st.integers(0, 1000), threshold=st.floats(0.2, 0.8))
def test_it_is_one_less_the_mean_of_soft_f1(seed: int, threshold: float) -> None:
    pred, target, valid = make_case(seed)
    losses = []
    for p, t, v in zip(*(x[:, 0].numpy() for x in (pred, target, valid)), strict=True):
        whole = ndimage.minimum_filter(v, size=3)[1:-1, 1:-1]
        edges = (slopes(np.where(v, t, 0)) > threshold) & whole
        soft = np.where(whole, 1 / (1 + np.exp(-4 * (slopes(np.where(v, p, 0)) / threshold - 1))), 0)
        if edges.any():
            losses.append(1 - 2 * soft[edges].sum() / (soft.sum() + edges.sum()))
    expected = np.mean(losses) if losses else 0
    assert float(edge_overlap_loss(pred, target, valid, threshold=threshold)) == pytest.approx(expected, abs=1e-6)


@given(seed=st.integers(0, 1000))
def test_steep_edges_are_counted_as_the_metric_counts_them(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    pred, target = (torch.rand(2, 3, 1, 9, 11, generator=generator) < 0.3).float() * 100  # a slope is 0 or at least 100
    valid = torch.rand(target.shape, generator=generator) > 0.01
    f1 = edge_scores(pred, target, valid, threshold=0.25)["f1"]
    assert float(edge_overlap_loss(pred, target, valid, threshold=0.25)) == pytest.approx(
        float((1 - f1).nanmean()),
        abs=0.02,  # sigmoid(-4): of a pixel without a slope
    )


def test_an_edge_costs_the_more_the_more_it_is_blurred_and_most_if_it_is_elsewhere() -> None:
    truth = step(0.3)
    valid = torch.ones_like(truth, dtype=torch.bool)
    sharp, soft, softest = (float(edge_overlap_loss(step(0.3, blurred=b), truth, valid)) for b in (0, 3, 9))
    elsewhere = float(edge_overlap_loss(truth.roll(4, -1).clamp(min=0.2), truth, valid))
    assert sharp < soft < softest < elsewhere


def test_an_image_without_edges_or_truth_does_not_count() -> None:
    pred, target, valid = make_case(1)
    some = edge_overlap_loss(pred[:1], target[:1], valid[:1])
    target[1], valid[2] = 0.3, False
    loss = edge_overlap_loss(pred, torch.where(valid, target, math.nan), valid)
    torch.testing.assert_close(loss, some)
    assert float(edge_overlap_loss(pred, target, torch.zeros_like(valid))) == 0


@pytest.mark.parametrize("size", [(1, 1), (2, 5)])
def test_images_too_small_for_a_window_have_no_edges(size: tuple[int, int]) -> None:
    depth = torch.rand(2, 1, *size, requires_grad=True)
    loss = edge_overlap_loss(depth, torch.rand(2, 1, *size), torch.ones(2, 1, *size, dtype=torch.bool))
    loss.backward()
    assert loss.item() == 0
    assert depth.grad is not None
    assert not depth.grad.any()


def test_gradients_are_right_and_finite_even_on_a_plane() -> None:
    pred, target, valid = make_case(2)
    pred.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: edge_overlap_loss(x, target, valid), pred)
    flat = torch.full_like(pred, 0.5, requires_grad=True)
    edge_overlap_loss(flat, target, valid).backward()
    assert flat.grad is not None
    assert flat.grad.isfinite().all()
    term = EdgeOverlap(threshold=0.2)(pred, target, torch.zeros(3, 3, 9, 11), valid)
    assert list(term.terms) == ["edges"]
    assert term.total.item() == pytest.approx(edge_overlap_loss(pred, target, valid, threshold=0.2).item(), rel=1e-6)


@pytest.mark.parametrize("threshold", [0, -0.1, math.nan])
def test_a_threshold_is_positive(threshold: float) -> None:
    with pytest.raises(ConfigError, match=r"loss\.threshold: "):
        EdgeOverlap(threshold=threshold)
