"""Who is measured when: all contenders take turns, so that a machine that slows down slows them all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hudepth.base.console import log
from hudepth.bench.worker import ContenderError, Worker

T = TypeVar("T")


@dataclass
class Sample:
    """The measurements of a contender at a batch size."""

    name: str
    batch: int
    first_pass_s: float
    result: NDArray[np.float32]
    rounds: list[list[float]] = field(default_factory=list)
    """Times [s] of the passes of each round."""
    peak_mb: float = 0.0


@dataclass
class Session:
    """A run of all contenders; one that fails is left out from there on, with a note, its smaller batches are kept."""

    batches: Sequence[int]
    """Images per pass, rising: memory that a smaller batch left behind is no more than a larger one needs."""
    repeats: int
    """Rounds at each batch size."""
    seconds: float
    longest_pass_s: float
    """A batch whose pass would take longer is left out."""
    contenders: Sequence[Worker] = ()
    before_round: Callable[[], None] = lambda: None
    """Measures the machine as often as the contenders are measured."""
    samples: list[Sample] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What was left out, and why."""

    @property
    def steps(self) -> int:
        """How many steps :meth:`run` takes if nothing fails."""
        return len(self.batches) * len(self.contenders) * (self.repeats + 1)

    def run(self) -> Iterator[None]:
        """Measure; yield after each step."""
        self._left = list(self.contenders)
        for batch in self.batches:
            here: dict[str, Sample] = {}
            for contender in list(self._left):
                if self._fits(contender, batch) and (begun := self._try(contender.begin, contender, batch, batch)):
                    here[contender.name] = Sample(contender.name, batch, begun.first_pass_s, begun.result)
                yield
            for number in range(self.repeats):
                self.before_round()
                # back and forth: a steady drift then adds the same to each
                for contender in self._left[:: -1 if number % 2 else 1]:
                    if sample := here.get(contender.name):
                        sample.rounds.append(self._try(contender.turn, contender, batch, self.seconds) or [])
                    yield
            for contender in list(self._left):
                if sample := here.get(contender.name):
                    sample.peak_mb = self._try(contender.peak_mb, contender, batch) or 0.0
            left = [contender.name for contender in self._left]
            self.samples += [sample for sample in here.values() if sample.name in left]

    def note(self, name: str, line: str) -> None:
        """Log a line about a contender, and keep it."""
        log.warning("%s: %s", name, line)
        self.notes.append(f"{name}: {line}")

    def _fits(self, contender: Worker, batch: int) -> bool:
        before = [sample for sample in self.samples if sample.name == contender.name]
        if not before:
            return True
        expected_s = batch / before[-1].batch * float(np.median([t for times in before[-1].rounds for t in times]))
        if expected_s <= self.longest_pass_s:
            return True
        self.note(contender.name, f"not measured at batch {batch}, where a pass would take about {expected_s:.0f} s")
        return False

    def _try(self, command: Callable[..., T], contender: Worker, batch: int, *arguments: float) -> T | None:
        """Send a command; a contender that fails is dropped."""
        try:
            return command(*arguments)
        except ContenderError as error:
            self._left = [other for other in self._left if other is not contender]  # not in place: it is iterated over
            self.note(contender.name, f"failed at batch {batch}: {error}")
            return None
