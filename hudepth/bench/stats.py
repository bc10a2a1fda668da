"""From times of passes to what a table states."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Timing:
    """How long a pass takes [ms]."""

    passes: int
    p25_ms: float
    p50_ms: float
    p75_ms: float
    p95_ms: float


def summarise(rounds: Sequence[Sequence[float]]) -> Timing:
    """Return the quantiles of all passes, those of all rounds together; between two times they are interpolated.

    Args:
        rounds: times [s] of the passes of each round, at least one in all.
    """
    times_ms = 1000 * np.asarray([time for times in rounds for time in times], np.float64)
    p25, p50, p75, p95 = (float(value) for value in np.percentile(times_ms, [25, 50, 75, 95]))
    return Timing(len(times_ms), p25, p50, p75, p95)


def images_per_s(batch: int, pass_ms: float) -> float:
    """Return the rate at which passes of ``batch`` images go through images."""
    return 1000 * batch / pass_ms


def times_as_fast(rounds: Sequence[Sequence[float]], reference: Sequence[Sequence[float]]) -> float:
    """Return how many times as fast as the reference something is: the median over rounds of the ratio in a round.

    Both ran in each round shortly after one another, so whatever slowed the machine for a while slowed both.

    Args:
        rounds: times of the passes of each round.
        reference: the same of what it is compared with, as many rounds, with passes of as many images.
    """
    pairs = zip(rounds, reference, strict=True)
    return statistics.median(statistics.median(theirs) / statistics.median(own) for own, theirs in pairs)


def gflop_per_s(flops: int, rate: float) -> float:
    """Return billions of operations a second.

    Args:
        flops: operations of an image; a multiply-add is two.
        rate: images a second.
    """
    return flops * rate / 1e9
