"""From the runs of a sweep to the rows of its table: which repeat which, which count, and what became of the others."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from hudepth.base.errors import ConfigError, DataError, HudepthError, did_you_mean
from hudepth.report.ablation.estimates import Contrast, Estimate
from hudepth.report.ablation.factors import ABSENT, Factor, find_factors, seed_of, variant, variant_key
from hudepth.runs.results import Result
from hudepth.runs.run import Run
from hudepth.runs.status import FINISHED
from hudepth.runs.sweeps import Sweep

VARIANT = "variant"  # the label that names a row
NO_RESULT, REPEATED, NOT_COMPOSED = "no result", "repeated", "not composed"


@dataclass(frozen=True)
class Trouble:
    """A run, or a job that never became one (``run`` is empty), that is in no mean."""

    run: str
    row: str
    seed: str
    state: str  # failed, pruned, interrupted, running, not composed, no result or repeated
    why: str

    def __str__(self) -> str:
        run = f"'{self.run}'" if self.run else "a job"
        return f"{run} of row '{self.row}', seed {self.seed}: {self.state}{f': {self.why}' if self.why else ''}"


@dataclass(frozen=True)
class Repetition:
    """A finished run with a result."""

    run: Run
    result: Result


@dataclass
class Row:
    """A row of the table: the runs of one configuration, and their metrics."""

    config: dict[str, Any]  # by dotted key, without seeds; see :func:`hudepth.report.ablation.factors.variant`
    named: str  # the label variant; empty if there is none
    seeds: list[str]  # all that were tried, lowest first
    label: str = ""
    factors: list[str] = field(default_factory=list)  # a formatted value for each factor of the table
    runs: dict[str, Repetition] = field(default_factory=dict)  # those that count, by seed, lowest first
    is_reference: bool = False
    differs: list[str] = field(default_factory=list)  # how its protocol, data or split differ from the reference's
    estimates: dict[str, Estimate] = field(default_factory=dict)
    contrasts: dict[str, Contrast] = field(default_factory=dict)  # empty if not paired with the reference
    best: set[str] = field(default_factory=set)  # metrics in which no comparable row is better

    @property
    def counted(self) -> str:
        """``3`` if all seeds that were tried count, else ``2 of 3``."""
        done, tried = len(self.runs), len(self.seeds)
        return str(done) if done == tried else f"{done} of {tried}"


@dataclass(frozen=True)
class Rows:
    """A sweep, sorted into rows."""

    rows: list[Row]
    factors: list[Factor]
    troubles: list[Trouble]


def sort_runs(sweep: Sweep, protocol: str, *, track: Callable[[list[Run]], Iterable[Run]] = iter) -> Rows:
    """Read the results of a protocol and sort runs into rows, in the order of the sweep; ``track`` shows progress."""
    groups: dict[str, list[tuple[Run, Result | str]]] = {}
    for run in track(sweep.runs):
        found: Result | str = ""  # or why there is none
        if run.state == FINISHED:
            try:
                found = run.result(protocol)
            except HudepthError as error:
                found = str(error)
        groups.setdefault(variant_key(run.config), []).append((run, found))
    rows = []
    for runs in ([run for run, _ in group] for group in groups.values()):
        names = dict.fromkeys(run.labels[VARIANT] for run in runs if run.labels.get(VARIANT))
        rows.append(Row(variant(runs[0].config), " / ".join(names), sort_seeds(seed_of(run.config) for run in runs)))
    factors = find_factors([row.config for row in rows])
    _label(rows, factors)
    troubles = [each for row, group in zip(rows, groups.values(), strict=True) for each in _fill(row, group)]
    troubles += [_never_composed(labels, error, rows) for labels, error in sweep.uncomposed]
    return Rows(rows, factors, troubles)


def choose_reference(table: Sequence[Row], name: str | None, *, protocol: str) -> Row:
    """Return the row that the others are compared with: ``name`` is a label or a ``variant``, None the first result.

    Raises ConfigError if there is no such row, DataError if no row has a result.
    """
    usable = [row for row in table if row.runs]
    result = f"a test result of protocol '{protocol}'"
    if not usable:
        raise DataError(f"no run of the sweep has finished with {result}. Wait for one, or pass protocol=<name>.")
    if name is None:
        return usable[0]
    found = [row for row in table if row.label == name]
    found = found or [row for row in table if name in (row.named, *row.named.split(" / "))]
    if not found:
        labels = [row.label for row in table]
        known = ", ".join(f"'{label}'" for label in labels[:8]) + f" and {len(labels) - 8} more" * (len(labels) > 8)
        raise ConfigError(f"reference: no row '{name}'.{did_you_mean(name, labels)} There are {known}.")
    if len(found) > 1:
        raise ConfigError(
            f"""reference: '{name}' is {len(found)} rows. Pass one, as in reference='"{found[0].label}"'."""
        )
    if not found[0].runs:
        fix = f"Pass another, as in reference='\"{usable[0].label}\"'."
        raise ConfigError(f"reference: '{name}' has no finished run with {result}. {fix}")
    return found[0]


def sort_seeds(seeds: Iterable[str]) -> list[str]:
    """Return seeds, each once, lowest first, numbers as numbers."""
    parts = {seed: [(not p.isdigit(), int(p) if p.isdigit() else 0, p) for p in re.split(r"/", seed)] for seed in seeds}
    return sorted(parts, key=lambda seed: parts[seed])


def _label(rows: Sequence[Row], factors: Sequence[Factor]) -> None:
    """Name each row after its label ``variant``, and after its factors if that is not unique."""
    times, taken = Counter(row.named for row in rows), Counter[str]()
    for number, row in enumerate(rows):
        row.factors = [factor.shown[number] for factor in factors]
        words = [f"{each.name}={each.shown[number]}" for each in factors if each.shown[number] != ABSENT]
        if row.named:
            words = [row.named] if times[row.named] == 1 else [row.named, *words]
        label = ", ".join(words) or "all runs"
        taken[label] += 1
        row.label = label if taken[label] == 1 else f"{label} #{taken[label]}"  # shortened values can look alike


def _fill(row: Row, group: Sequence[tuple[Run, Result | str]]) -> list[Trouble]:
    """Give a row the runs that count; return the others."""
    group = sorted(group, key=lambda pair: pair[0].path.name)
    last = {seed_of(run.config): (run, found) for run, found in group if isinstance(found, Result)}
    row.runs = {seed: Repetition(*last[seed]) for seed in sort_seeds(last)}
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


def _never_composed(labels: dict[str, str], error: str, rows: Sequence[Row]) -> Trouble:
    named, seed = labels.get(VARIANT, ""), labels.get("seed", ABSENT)
    row = next((each for each in rows if named and named in each.named.split(" / ")), None)
    if row is not None and seed != ABSENT:
        row.seeds = sort_seeds([*row.seeds, seed])
    words = [f"{key}={value}" for key, value in labels.items() if key not in (VARIANT, "seed")]
    label = row.label if row is not None else ", ".join(filter(None, [named, *words]))
    return Trouble("", label, seed, NOT_COMPOSED, " ".join(error.split()))
