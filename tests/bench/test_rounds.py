from __future__ import annotations

import numpy as np
import pytest

from hudepth.bench.rounds import Session
from hudepth.bench.worker import Begun, ContenderError, Worker

CALLS = list[tuple[str, str, float]]


class Fake(Worker):
    """Takes the same time for every image, and fails when it is told to."""

    def __init__(self, name: str, calls: CALLS, *, image_s: float = 0.1, fails: tuple[str, int] | None = None) -> None:
        self.name, self.calls, self.image_s, self.fails = name, calls, image_s, fails
        self.batch = 0

    def begin(self, batch: int) -> Begun:
        self.batch = batch
        self._call("begin", batch)
        return Begun(9.0, np.full((batch, 1, 2, 2), 0.5, np.float32))

    def turn(self, seconds: float) -> list[float]:
        self._call("turn", seconds)
        return [self.image_s * self.batch] * 2

    def peak_mb(self) -> float:
        self._call("peak", 0)
        return 7.0 * self.batch

    def _call(self, what: str, value: float) -> None:
        self.calls.append((self.name, what, value))
        if self.fails == (what, self.batch):
            raise ContenderError("it broke")


def measured(*fakes: Fake, batches: tuple[int, ...] = (1, 2), repeats: int = 3, **options: object) -> Session:
    session = Session(batches, repeats, 0.25, 10.0, fakes, **options)  # type: ignore[arg-type]
    for _ in session.run():
        pass
    return session


def test_all_take_turns_forth_and_back() -> None:
    calls: CALLS = []
    session = measured(*(Fake(name, calls) for name in "abc"), batches=(4,))
    assert [name + what[0] for name, what, _ in calls] == [
        "ab", "bb", "cb", "at", "bt", "ct", "ct", "bt", "at", "at", "bt", "ct", "ap", "bp", "cp",
    ]  # fmt: skip
    assert {value for _, what, value in calls if what == "turn"} == {0.25}
    sample = session.samples[0]
    assert (sample.name, sample.batch, sample.first_pass_s, sample.peak_mb) == ("a", 4, 9.0, 28.0)
    assert sample.rounds == [[0.4, 0.4]] * 3


def test_batches_follow_one_another_and_every_step_is_told() -> None:
    calls: CALLS = []
    session = Session([1, 2], 3, 0.1, 10.0, [Fake("a", calls), Fake("b", calls)])
    assert sum(1 for _ in session.run()) == session.steps == 16
    assert [(sample.name, sample.batch) for sample in session.samples] == [("a", 1), ("b", 1), ("a", 2), ("b", 2)]


def test_the_machine_is_measured_as_often_as_the_contenders() -> None:
    calls: CALLS = []
    measured(Fake("a", calls), repeats=2, before_round=lambda: calls.append(("machine", "product", 0)))
    assert [name[0] + what[0] for name, what, _ in calls] == ["ab", "mp", "at", "mp", "at", "ap"] * 2


@pytest.mark.parametrize(("what", "kept"), [("begin", []), ("turn", []), ("peak", [])])
def test_one_that_fails_is_a_note_and_the_rest_is_done(what: str, kept: list[int]) -> None:
    calls: CALLS = []
    session = measured(Fake("a", calls), Fake("b", calls, fails=(what, 2)), Fake("c", calls), batches=(1, 2, 4))
    assert session.notes == ["b: failed at batch 2: it broke"]
    found = {name: [sample.batch for sample in session.samples if sample.name == name] for name in "abc"}
    assert found == {"a": [1, 2, 4], "b": [1, *kept], "c": [1, 2, 4]}
    assert all(len(sample.rounds) == 3 for sample in session.samples)
    assert ("b", "begin", 4) not in calls


def test_passes_that_would_take_too_long_are_left_out() -> None:
    calls: CALLS = []
    session = measured(Fake("slow", calls, image_s=4.0), Fake("fast", calls), batches=(1, 2, 4))
    assert session.notes == ["slow: not measured at batch 4, where a pass would take about 16 s"]
    assert [sample.batch for sample in session.samples if sample.name == "fast"] == [1, 2, 4]
    assert [sample.batch for sample in session.samples if sample.name == "slow"] == [1, 2]
