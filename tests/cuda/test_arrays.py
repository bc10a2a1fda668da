"""On a stand-in for a GPU, replayed functions of arrays are the usual ones to the last bit."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import Tensor

from hudepth.cuda import arrays, graphs
from hudepth.cuda.arrays import ArrayGraphs
from tests.devices import with_graphs

CPU = torch.device("cpu")


class Halves:
    """Half of each number; keeps the shapes it was called with."""

    def __init__(self) -> None:
        self.shapes: list[tuple[int, ...]] = []

    def __call__(self, x: Tensor) -> Tensor:
        self.shapes.append(tuple(x.shape))
        return x.float() / 2


def array(*shape: int) -> np.ndarray:
    return np.random.default_rng(sum(shape)).integers(0, 255, shape, dtype=np.uint8)


def test_from_the_fourth_on_it_replays() -> None:
    halves = Halves()
    with with_graphs():
        halved = ArrayGraphs(halves, CPU, what="it")
        results = []
        for number in range(6):
            given = array(3, 4) + np.uint8(number)
            results.append((halved(given), given / np.float32(2)))
    assert len(halves.shapes) == graphs.WARM_UPS + 1  # as usual, and recorded
    for found, expected in results:  # all of them: none lies where the next one was written
        np.testing.assert_array_equal(found, expected)
        assert found.dtype == np.float32


def test_each_shape_has_a_recording_and_few_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "MOST", 2)
    halves = Halves()
    with with_graphs():
        halved = ArrayGraphs(halves, CPU, what="it")

        def calls(count: int) -> int:
            before = len(halves.shapes)
            for seed in range(5):
                given = array(count, 2) + np.uint8(seed)
                np.testing.assert_array_equal(halved(given), given / np.float32(2))
            return len(halves.shapes) - before

        first = graphs.WARM_UPS + 1
        assert [calls(1), calls(2), calls(1)] == [first, first, 0]
        assert calls(3) == first  # in place of two, which was not used for longest
        assert [calls(1), calls(2)] == [0, first]
        assert [calls(2), calls(3)] == [0, first]
        assert calls(1) == first


def test_types_are_told_apart() -> None:
    with with_graphs():
        halved = ArrayGraphs(Halves(), CPU, what="it")
        for kind in (np.uint8, np.int16) * 5:
            given = array(2, 2).astype(kind)
            np.testing.assert_array_equal(halved(given), given / np.float32(2))


def test_what_cannot_be_recorded_is_computed_as_usual_after_one_line(caplog: pytest.LogCaptureFixture) -> None:
    halves = Halves()

    def waits_for_large(x: Tensor) -> Tensor:
        return halves(x) if len(x) < 5 else halves(x) + x.float().sum().item()

    with with_graphs(), caplog.at_level(logging.INFO, "hudepth"):
        halved = ArrayGraphs(waits_for_large, CPU, what="the network")
        for count in (2, 6, 7) * 6:
            given = array(count)
            expected = given / np.float32(2) + (given.sum() if count > 4 else 0)
            np.testing.assert_array_equal(halved(given), expected)
    (line,) = caplog.messages
    assert line.startswith("the network is not replayed as a CUDA graph, and slower: ")
    assert "item" in line
    assert halves.shapes.count((2,)) == graphs.WARM_UPS + 1  # what was recorded still is


class Full(Halves):
    """A GPU without room for more than four rows while there are recordings; without, for ten."""

    halved: ArrayGraphs

    def __call__(self, x: Tensor) -> Tensor:
        if len(x) > (4 if self.halved._known else 10):
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return super().__call__(x)


def test_recordings_make_room(caplog: pytest.LogCaptureFixture) -> None:
    full = Full()
    with with_graphs(), caplog.at_level(logging.INFO, "hudepth"):
        full.halved = ArrayGraphs(full, CPU, what="it")
        with pytest.raises(torch.OutOfMemoryError):
            full.halved(array(11))
        for count in (2, 2, 2, 2, 8, 2, 2, 2, 2, 2, 8):
            np.testing.assert_array_equal(full.halved(array(count)), array(count) / np.float32(2))
        with pytest.raises(torch.OutOfMemoryError):
            full.halved(array(11))
    assert caplog.messages == ["it is not replayed as a CUDA graph, and slower: CUDA out of memory."]


def test_threads_take_turns() -> None:
    inside = threading.Lock()

    def alone(x: Tensor) -> Tensor:
        assert inside.acquire(blocking=False)
        try:
            return x.float() / 2
        finally:
            inside.release()

    def work(number: int) -> None:
        for seed in range(50):
            given = array(1 + seed % 3, 64, 64) + np.uint8(number)
            np.testing.assert_array_equal(both[seed % 2](given), given / np.float32(2))

    with with_graphs(), ThreadPoolExecutor(4) as pool:
        both = [ArrayGraphs(alone, CPU, what=what) for what in ("one", "other")]
        list(pool.map(work, range(4)))
