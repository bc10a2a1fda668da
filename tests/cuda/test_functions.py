"""Replayed functions return what the functions do, keep what they returned, and go on if they cannot be recorded."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from hudepth.base.types import RawBatch
from hudepth.cuda import graphs
from hudepth.cuda.functions import Replayed
from hudepth.data.augment import Augmentation
from hudepth.data.preprocess import TrainingBatches
from tests.data.test_augment import EVERYTHING
from tests.devices import with_graphs


def test_a_replayed_function() -> None:
    calls = []

    def function(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        calls.append(None)
        return {"sum": tensors["a"] + tensors["b"], "a": tensors["a"]}

    replayed = Replayed("this")
    with with_graphs():
        results = []
        for i in range(8):
            a, b = torch.full((2,), float(i)), torch.full((2,), 100.0)
            results.append(replayed(function, {"a": a, "b": b}))
        assert len(calls) == graphs.WARM_UPS + 1
        assert [result["sum"].tolist() for result in results] == [[100.0 + i] * 2 for i in range(8)]
        assert [result["a"].tolist() for result in results] == [[float(i)] * 2 for i in range(8)]
        replayed(function, {"a": torch.ones(3), "b": torch.ones(3)})  # another shape
        replayed(function, {"a": torch.ones(2), "b": torch.ones(2)}, setting="other")
        assert len(calls) == graphs.WARM_UPS + 3


def test_a_function_that_waits_runs_as_usual(caplog: pytest.LogCaptureFixture) -> None:
    def function(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {"double": tensors["a"] * 2 if tensors["a"].sum() > 0 else tensors["a"]}

    replayed = Replayed("this")
    with caplog.at_level(logging.INFO, "hudepth"), with_graphs():
        for i in range(8):
            assert replayed(function, {"a": torch.tensor([float(i)])})["double"].item() == 2 * i
    assert len([line for line in caplog.messages if line.startswith("this is not replayed as a CUDA graph")]) == 1


def raw(generator: torch.Generator, *, teacher: bool) -> RawBatch:
    batch = RawBatch(
        image=torch.randint(256, (3, 24, 32, 3), generator=generator).to(torch.uint8),
        stored_depth=torch.randint(9000, (3, 24, 32), generator=generator).to(torch.uint16),
        index=torch.randint(100, (3,), generator=generator),
        per_m=1000,
    )
    if teacher:
        batch["teacher_m"] = torch.rand(3, 24, 32, generator=generator)
    return batch


@pytest.mark.parametrize("teacher", [False, True])
@pytest.mark.parametrize("augment", [None, {**EVERYTHING, "blur": 0.0}], ids=["plain", "augmented"])
def test_replayed_batches_are_the_usual_ones(augment: dict[str, Any] | None, *, teacher: bool) -> None:
    def batches(*, size: tuple[int, int] = (16, 24)) -> list[dict[str, Tensor]]:
        generator, draws = torch.Generator().manual_seed(0), torch.Generator().manual_seed(1)
        training = TrainingBatches(Augmentation(**augment) if augment else None, max_depth_m=5.0)
        made = [raw(generator, teacher=teacher) for _ in range(7)]
        return [dict(training(batch, size=size, aspect=4 / 3, generator=draws)) for batch in made]

    usual = batches()
    with with_graphs():
        replayed = batches()
    for one, other in zip(usual, replayed, strict=True):
        assert one.keys() == other.keys()
        assert all(value.equal(other[name]) for name, value in one.items())
