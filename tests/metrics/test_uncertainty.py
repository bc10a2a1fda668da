from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import spearmanr

from hudepth.metrics.uncertainty import STEPS, ause, rank_correlation, uncertainty_metrics

values = st.lists(st.floats(0.01, 5), min_size=2, max_size=40)


def by_hand(error: list[float], uncertainty: list[float]) -> float:
    """Step by step, in plain Python: what is left without the most uncertain pixels, and without the worst."""

    def left(keys: list[float], step: int) -> float:
        order = sorted(range(len(error)), key=lambda i: keys[i])
        kept = order[: math.ceil(len(error) * (STEPS - step) / STEPS)]
        return sum(error[i] for i in kept) / len(kept)

    gaps = [left(uncertainty, step) - left(error, step) for step in range(STEPS)]
    return sum(gaps) / STEPS / (sum(error) / len(error))


@given(values, st.integers(0, 99))
def test_the_area_under_the_sparsification_error(error: list[float], seed: int) -> None:
    unsure = np.random.default_rng(seed).random(len(error)).tolist()
    found = ause(torch.tensor(error, dtype=torch.float64), torch.tensor(unsure))
    assert found.item() == pytest.approx(by_hand(error, unsure), abs=1e-9)
    assert found >= -1e-12  # no order is better than that of the errors


@given(values)
def test_the_order_of_the_errors_is_perfect_whatever_the_scale(error: list[float]) -> None:
    exact = torch.tensor(error, dtype=torch.float64)
    assert ause(exact, exact**3).item() == pytest.approx(0, abs=1e-12)


@given(values, st.integers(0, 99))
def test_the_rank_correlation_is_scipys(error: list[float], seed: int) -> None:
    other = np.random.default_rng(seed).integers(0, 5, len(error)).astype(float)  # with ties
    if len(set(error)) < 2 or len(set(other)) < 2:
        return
    found = rank_correlation(torch.tensor(error, dtype=torch.float64), torch.tensor(other))
    assert found.item() == pytest.approx(spearmanr(error, other).statistic, abs=1e-9)


def test_only_valid_pixels_count_and_an_empty_image_is_undefined() -> None:
    random = torch.Generator().manual_seed(0)
    truth = torch.rand(2, 1, 6, 7, generator=random) + 1
    pred, unsure = truth + torch.rand(2, 1, 6, 7, generator=random), torch.rand(2, 1, 6, 7, generator=random)
    valid = torch.rand(2, 1, 6, 7, generator=random) > 0.3
    valid[1] = False
    found = uncertainty_metrics(pred, truth, valid, unsure)
    error = ((pred - truth).abs() / truth)[0][valid[0]].double()
    share = (unsure / pred)[0][valid[0]]
    assert found[0, 0].item() == pytest.approx(by_hand(error.tolist(), share.tolist()))
    assert found[1].isnan().all()
    spoilt = torch.where(valid, pred, torch.nan)
    torch.testing.assert_close(uncertainty_metrics(spoilt, truth, valid, unsure), found, equal_nan=True)
