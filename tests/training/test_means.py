"""Means of an epoch's losses: against the mean over all images, whatever the batches and processes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from hudepth.training.means import EpochMeans
from tests.devices import without_float64

images = st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=40)


def feed(means: EpochMeans, values: list[float], cuts: list[int]) -> None:
    edges = sorted({0, len(values), *(cut % len(values) for cut in cuts)})
    for start, end in pairwise(edges):
        batch = torch.tensor(values[start:end])
        means.add({"total": batch.mean(), "negative": -batch.mean()}, images=len(batch))


def alone(x: Tensor) -> Tensor:
    return x


@given(values=images, cuts=st.lists(st.integers(0, 100), max_size=6))
def test_every_image_counts_once_whatever_the_batches(values: list[float], cuts: list[int]) -> None:
    means = EpochMeans()
    feed(means, values, cuts)
    found = means.take(alone)
    assert found["total"].item() == pytest.approx(np.mean(values), rel=1e-5, abs=1e-3)
    assert found["negative"].item() == -found["total"].item()
    assert means.take(alone) == {}


def test_processes_count_by_their_images() -> None:
    first, second = EpochMeans(), EpochMeans()
    feed(first, [1.0, 2.0, 6.0], [])
    feed(second, [11.0], [])
    sums = []
    second.take(lambda x: sums.append(x) or x)
    assert first.take(lambda x: x + sums[0])["total"].item() == 5.0


def test_a_value_that_only_some_batches_have() -> None:
    means = EpochMeans()
    means.add({"total": torch.tensor(1.0)}, images=3)
    means.add({"total": torch.tensor(5.0), "distill": torch.tensor(2.0)}, images=1)
    assert {name: value.item() for name, value in means.take(alone).items()} == {"total": 2.0, "distill": 2.0}


def test_sums_of_half_precision_are_kept_in_full() -> None:
    means = EpochMeans()
    for _ in range(3000):
        means.add({"total": torch.tensor(1.0, dtype=torch.bfloat16)}, images=1)
    means.add({"total": torch.tensor(3001.0)}, images=1)
    assert means.take(alone)["total"].item() == pytest.approx(6001 / 3001)


def test_a_device_without_float64() -> None:
    means = EpochMeans()
    with without_float64():
        feed(means, [1.0, 2.0, 6.0], [1])
        assert means.take(alone)["total"].item() == 3.0
