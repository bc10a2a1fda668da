"""From the runs of a sweep to the rows of its table: which repeat which, which count, and what became of the others."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from hudepth.base.errors import HudepthError
from hudepth.report.ablation.factors import ABSENT, Factor, find_factors, seed_of, variant, variant_key
from hudepth.runs.results import Result, find_result
from hudepth.runs.sweeps import FINISHED, Sweep, SweepRun

VARIANT = "variant"
"""The label that names a row."""
NO_RESULT, REPEATED, NOT_COMPOSED = "no result", "repeated", "not composed"


@dataclass(frozen=True)
class Trouble:
    """A run, or what should have become one, that is in no mean."""

    run: str
    """Its folder's name; empty if it never had one."""
    row: str
    seed: str
    state: str
    """``failed``, ``pruned``, ``interrupted``, ``running``; ``not composed``; finished but ``no result`` or
    ``repeated``."""
    why: str


@dataclass(frozen=True)
class Repetition:
    """A finished run with a result."""

    run: SweepRun
    result: Result


@dataclass
class Variant:
    """A row: runs of one configuration."""

    config: dict[str, Any]
    """By dotted key, without seeds; see :func:`hudepth.report.ablation.factors.variant`."""
    named: str
    """By the label ``variant``; empty if there is none."""
    label: str = ""
    factors: list[str] = field(default_factory=list)
    """A value in letters for each factor of the table."""
    runs: dict[str, Repetition] = field(default_factory=dict)
    """Those that count, by seed, lowest first."""
    seeds: list[str] = field(default_factory=list)
    """All that were tried, lowest first."""


@dataclass(frozen=True)
class Rows:
    """A sweep, sorted into rows."""

    variants: list[Variant]
    factors: list[Factor]
    troubles: list[Trouble]


def sort_runs(sweep: Sweep, protocol: str, *, track: Callable[[list[SweepRun]], Iterable[SweepRun]] = iter) -> Rows:
    """Read the results of a sweep's runs and sort them into rows, in the order of the sweep.

    Args:
        sweep: as read.
        protocol: whose results to read.
        track: wraps the list of runs, for a progress bar.
    """
    groups: dict[str, list[tuple[SweepRun, Result | str]]] = {}
    for run in track(sweep.runs):
        groups.setdefault(variant_key(run.config), []).append((run, _result(run, protocol)))
    variants = [_variant([run for run, _ in group]) for group in groups.values()]
    factors = find_factors([each.config for each in variants])
    _label(variants, factors)
    troubles: list[Trouble] = []
    for each, group in zip(variants, groups.values(), strict=True):
        troubles += _fill(each, group)
    for labels, error in sweep.uncomposed:
        troubles.append(_never_composed(labels, error, variants))
    return Rows(variants, factors, troubles)


def in_order(seeds: Iterable[str]) -> list[str]:
    """Return seeds, each once, lowest first, numbers as numbers."""
    parts = {seed: [(not p.isdigit(), int(p) if p.isdigit() else 0, p) for p in re.split(r"/", seed)] for seed in seeds}
    return sorted(parts, key=lambda seed: parts[seed])


def _result(run: SweepRun, protocol: str) -> Result | str:
    """Return a finished run's result, or why there is none; the word is empty for runs that did not finish."""
    if run.state != FINISHED:
        return ""
    try:
        return find_result(run.path, protocol)
    except HudepthError as error:
        return str(error)


def _variant(runs: Sequence[SweepRun]) -> Variant:
    names = dict.fromkeys(run.labels[VARIANT] for run in runs if run.labels.get(VARIANT))
    return Variant(variant(runs[0].config), " / ".join(names), seeds=in_order(seed_of(run.config) for run in runs))


def _label(variants: Sequence[Variant], factors: Sequence[Factor]) -> None:
    """Name each row after its label ``variant``, and after its factors where that does not tell it apart."""
    times = Counter(each.named for each in variants)
    taken: Counter[str] = Counter()
    for number, each in enumerate(variants):
        each.factors = [factor.shown[number] for factor in factors]
        cells = zip(factors, each.factors, strict=True)
        words = [f"{factor.name}={cell}" for factor, cell in cells if cell != ABSENT]
        if each.named and times[each.named] == 1:
            words = []
        label = ", ".join([each.named, *words] if each.named else words) or "all runs"
        taken[label] += 1
        each.label = label if taken[label] == 1 else f"{label} #{taken[label]}"  # cut values can look alike


def _fill(row: Variant, group: Sequence[tuple[SweepRun, Result | str]]) -> list[Trouble]:
    """Give a row the runs that count; return the others."""
    group = sorted(group, key=lambda pair: pair[0].path.name)
    last = {seed_of(run.config): (run, found) for run, found in group if isinstance(found, Result)}
    row.runs = {seed: Repetition(*last[seed]) for seed in in_order(last)}
    troubles = []
    for run, found in group:
        seed, state, why = seed_of(run.config), run.state, run.error
        if isinstance(found, Result):
            if row.runs[seed].run is run:
                continue
            state, why = REPEATED, f"same configuration and seed as '{row.runs[seed].run.path.name}', which counts"
        elif found:
            state, why = NO_RESULT, found
        troubles.append(Trouble(run.path.name, row.label, seed, state, " ".join(why.split())))
    return troubles


def _never_composed(labels: dict[str, str], error: str, variants: Sequence[Variant]) -> Trouble:
    named, seed = labels.get(VARIANT, ""), labels.get("seed", ABSENT)
    row = next((each for each in variants if named and named in each.named.split(" / ")), None)
    if row is not None and seed != ABSENT:
        row.seeds = in_order([*row.seeds, seed])
    words = [f"{key}={value}" for key, value in labels.items() if key not in (VARIANT, "seed")]
    label = row.label if row is not None else ", ".join([named, *words] if named else words)
    return Trouble("", label, seed, NOT_COMPOSED, " ".join(error.split()))
