"""Who is measured when: all contenders in turns, so that a machine that slows down slows them all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hudepth.base.console import log
from hudepth.bench.worker import Begun, ContenderError


@runtime_checkable
class Contender(Protocol):
    """What is measured; see :class:`hudepth.bench.worker.Worker`, whose commands these are."""

    name: str

    def begin(self, batch: int) -> Begun:
        """Turn to a batch size."""
        ...

    def turn(self, seconds: float) -> list[float]:
        """Time some passes [s]."""
        ...

    def peak_mb(self) -> float:
        """Return the most memory [MB] since the last :meth:`begin`."""
        ...


@dataclass
class Sample:
    """What was measured of a contender at a batch size."""

    name: str
    batch: int
    first_pass_s: float
    result: NDArray[np.float32]
    rounds: list[list[float]] = field(default_factory=list)
    """Times [s] of the passes of each round."""
    peak_mb: float = 0.0


@dataclass
class Session:
    """A run of all contenders over all batch sizes.

    A contender that fails is left out from there on, with a note; what it gave at smaller batches is kept.
    """

    contenders: Sequence[Contender]
    batches: Sequence[int]
    """Images a pass, rising: memory that a smaller batch left behind is no more than a larger one needs."""
    repeats: int
    """Rounds at each batch size."""
    seconds: float
    """Of timed passes in a turn."""
    longest_pass_s: float
    """A batch whose pass would take longer is left out."""
    only: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """Contenders that are measured at some of the batch sizes alone, and at which."""
    before_round: Callable[[], None] = lambda: None
    """What is measured of the machine as often as the contenders are."""
    samples: list[Sample] = field(default_factory=list)
    notes: dict[str, list[str]] = field(default_factory=dict)
    """By contender."""

    def __post_init__(self) -> None:
        self.enter(self.contenders)

    def enter(self, contenders: Sequence[Contender]) -> None:
        """Say who takes part."""
        self.contenders = contenders
        self._left = list(contenders)

    @property
    def steps(self) -> int:
        """How many steps :meth:`run` takes if nothing fails."""
        return len(self.batches) * len(self.contenders) * (self.repeats + 1)

    def run(self) -> Iterator[None]:
        """Measure; yield after each step."""
        for batch in self.batches:
            here: dict[str, Sample] = {}
            for contender in list(self._left):
                if self._fits(contender, batch):
                    self._begin(contender, batch, here)
                yield
            for number in range(self.repeats):
                self.before_round()
                # forth and back: a steady drift then adds the same to each
                for contender in self._left[:: -1 if number % 2 else 1]:
                    if contender.name in here:
                        self._turn(contender, batch, here)
                    yield
            for contender in list(self._left):
                if contender.name in here:
                    self._end(contender, batch, here)
            self.samples += here.values()

    def note(self, name: str, line: str) -> None:
        """Keep a line about a contender, and say it."""
        log.warning("%s: %s", name, line)
        self.notes.setdefault(name, []).append(line)

    def _fits(self, contender: Contender, batch: int) -> bool:
        if batch not in self.only.get(contender.name, [batch]):
            return False
        before = [sample for sample in self.samples if sample.name == contender.name]
        if not before:
            return True
        expected_s = batch / before[-1].batch * float(np.median([t for times in before[-1].rounds for t in times]))
        if expected_s <= self.longest_pass_s:
            return True
        self.note(contender.name, f"not measured at batch {batch}, where a pass would take about {expected_s:.0f} s")
        return False

    def _begin(self, contender: Contender, batch: int, here: dict[str, Sample]) -> None:
        try:
            begun = contender.begin(batch)
        except ContenderError as error:
            self._drop(contender, batch, error, here)
        else:
            here[contender.name] = Sample(contender.name, batch, begun.first_pass_s, begun.result)

    def _turn(self, contender: Contender, batch: int, here: dict[str, Sample]) -> None:
        try:
            here[contender.name].rounds.append(contender.turn(self.seconds))
        except ContenderError as error:
            self._drop(contender, batch, error, here)

    def _end(self, contender: Contender, batch: int, here: dict[str, Sample]) -> None:
        try:
            here[contender.name].peak_mb = contender.peak_mb()
        except ContenderError as error:
            self._drop(contender, batch, error, here)

    def _drop(self, contender: Contender, batch: int, error: ContenderError, here: dict[str, Sample]) -> None:
        self._left = [other for other in self._left if other is not contender]  # a new list: the old is gone through
        here.pop(contender.name, None)
        self.note(contender.name, f"failed at batch {batch}: {error}")
