"""Means over seeds, differences between rows, and the uncertainty of both.

    seeds    another seed gives another network: Student's t over the seeds' values, or over their paired differences
    scenes   another test set has other scenes: bootstrap of the mean over the seeds, every seed with the same draws

A difference is shown only if every interval there is excludes 0: 95 % intervals of one metric and row each, so that
among many rows some differ by chance.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hudepth.metrics.bootstrap import LEVEL, Draws, interval_of, student_quantile
from hudepth.metrics.catalogue import metric_info

BETTER, WORSE, NOT_SHOWN = "better", "worse", "not shown"
BySeed = Mapping[str, Draws]


@dataclass(frozen=True)
class Interval:
    """From low to high; NaN if there is none."""

    low: float = math.nan
    high: float = math.nan

    @property
    def known(self) -> bool:
        """Whether there is one."""
        return not (math.isnan(self.low) or math.isnan(self.high))

    @property
    def excludes_zero(self) -> bool:
        """Whether 0 lies outside."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class Estimate:
    """A metric of a row."""

    values: dict[str, float]  # by seed
    mean: float  # over seeds; NaN if the metric is undefined for one of them
    seeds: Interval
    scenes: Interval


@dataclass(frozen=True)
class Contrast:
    """A metric of a row minus that of the reference."""

    value: float  # mean over the paired seeds
    seeds: Interval
    scenes: Interval
    paired: list[str]  # the seeds that both rows have
    verdict: str  # better, worse or not shown


def over_seeds(values: Sequence[float]) -> Interval:
    """Return the t interval of a mean; none for fewer than two values or where one is not finite."""
    if len(values) < 2 or not all(math.isfinite(value) for value in values):
        return Interval()
    mean = math.fsum(values) / len(values)
    variance = math.fsum((value - mean) ** 2 for value in values) / (len(values) - 1)
    half = student_quantile(len(values) - 1, level=LEVEL) * math.sqrt(variance / len(values))
    return Interval(mean - half, mean + half)


def estimate(name: str, values: Mapping[str, float], draws: BySeed) -> Estimate:
    """Return a metric of a row from its values by seed, at least one.

    ``draws``, by seed, are of the same images and with the same draws; empty if seeds were tested on different images.
    """
    numbers = list(values.values())
    return Estimate(dict(values), _mean(numbers), over_seeds(numbers), _over_scenes(name, draws.values()))


def contrast(
    name: str, row: Mapping[str, float], reference: Mapping[str, float], row_draws: BySeed, reference_draws: BySeed
) -> Contrast | None:
    """Return how a row differs from the reference in a metric, paired by seed; None if they have no seed in common.

    Values and draws are by seed, the draws of the same images and with the same draws of scenes.
    """
    paired = [seed for seed in reference if seed in row]
    if not paired:
        return None
    steps = [row[seed] - reference[seed] for seed in paired]
    sides = ([draws[seed] for seed in paired if seed in draws] for draws in (row_draws, reference_draws))
    value, seeds, scenes = _mean(steps), over_seeds(steps), _over_scenes(name, *sides)
    return Contrast(value, seeds, scenes, paired, verdict(name, value, seeds, scenes))


def verdict(name: str, value: float, seeds: Interval, scenes: Interval) -> str:
    """Return what a difference shows: better or worse only if every interval there is excludes 0."""
    known = [interval for interval in (seeds, scenes) if interval.known]
    if not known or not all(interval.excludes_zero for interval in known):
        return NOT_SHOWN
    return BETTER if (value > 0) == metric_info(name).higher_is_better else WORSE


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if all(map(math.isfinite, values)) else math.nan


def _over_scenes(name: str, draws: Collection[Draws], minus: Collection[Draws] = ()) -> Interval:
    """Return the interval of the mean over seeds, of a metric or of its differences."""
    sides = [*draws, *minus]
    if not draws or not all(name in each.metrics for each in sides):
        return Interval()
    total = np.mean([each.metrics[name] for each in draws], axis=0)
    if minus:
        total = total - np.mean([each.metrics[name] for each in minus], axis=0)
    return Interval(*interval_of(total, min(each.scenes[name] for each in sides)))
