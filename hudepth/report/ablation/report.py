"""A sweep in numbers: the metrics of each row, and how they differ from those of the reference."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hudepth.base.errors import HudepthError
from hudepth.base.files import read_json
from hudepth.metrics.bootstrap import REPEATS, SEED, Draws, Resampler, describe
from hudepth.metrics.catalogue import metric_info, metric_names
from hudepth.report.ablation.estimates import contrast, estimate
from hudepth.report.ablation.factors import Factor
from hudepth.report.ablation.rows import Row, Rows, Trouble, choose_reference
from hudepth.runs.comparison import paired, stamp_differences
from hudepth.runs.results import Result

NAMED = 3  # most runs that a warning lists by name


@dataclass(frozen=True)
class Report:
    """Everything in the report of a sweep."""

    protocol: str
    metrics: list[str]
    factors: list[Factor]
    rows: list[Row]
    reference: Row
    troubles: list[Trouble]
    warnings: list[str]
    first: Result  # the reference's result of its lowest seed: what the others are compared with
    uncertainty: dict[str, Any]  # see :func:`hudepth.metrics.bootstrap.describe`
    versions: dict[str, list[str]]  # names of the runs that count, by the version of hudepth that trained them


def make_report(
    rows: Rows, *, protocol: str, reference: str | None = None, repeats: int = REPEATS, seed: int = SEED
) -> Report:
    """Compute a sweep's table; ``repeats`` and ``seed`` are those of the bootstrap.

    ``reference``, ConfigError and DataError: see :func:`hudepth.report.ablation.rows.choose_reference`.
    """
    table = rows.rows
    warnings: list[str] = []
    chosen = choose_reference(table, reference, protocol=protocol)
    chosen.is_reference = True
    if reference is None and chosen is not table[0]:
        warnings.append(f"'{table[0].label}' has no result, so '{chosen.label}' is the reference")
    first = next(iter(chosen.runs.values())).result
    known = {name for row in table for each in row.runs.values() for name in each.result.metrics}
    metrics = [*metric_names("narrow", among=known), *metric_names("edge", among=known)]
    for row in table:
        row.differs = list(dict.fromkeys(line for r in row.runs.values() for line in _differences(first, r.result)))
        if row.differs:
            who = "the seeds of the reference" if row is chosen else f"'{row.label}' and the reference"
            warnings.append(f"{who} do not compare: {'; '.join(row.differs)}")
    sampler = Resampler(first.table, repeats=repeats, seed=seed)
    basis = {} if chosen.differs else _draws(chosen, first, metrics, sampler)
    for row in [chosen, *(row for row in table if row is not chosen)]:  # the others need its metrics
        _compute(row, chosen, basis, first, metrics, sampler)
    comparable = [row for row in table if row.runs and not row.differs]
    for name in metrics if len(comparable) > 1 else ():
        means = {row.label: row.estimates[name].mean for row in comparable}
        finite = [mean for mean in means.values() if not math.isnan(mean)]
        best = (max if metric_info(name).higher_is_better else min)(finite, default=math.nan)
        for row in comparable:
            if means[row.label] == best:
                row.best.add(name)
    versions = _versions_of(table)
    warnings += [*_undefined(table, metrics), *_unpaired(table, chosen), *_other_versions(versions, chosen)]
    uncertainty = describe(first.table, repeats=repeats, seed=seed)
    return Report(protocol, metrics, rows.factors, table, chosen, rows.troubles, warnings, first, uncertainty, versions)


def _differences(first: Result, other: Result) -> list[str]:
    """Return what keeps a result from being paired with the first of the reference."""
    if lines := stamp_differences(first, other):
        return lines
    try:
        paired(first, other)
    except HudepthError as error:
        return [str(error)]
    return []


def _draws(row: Row, first: Result, metrics: Sequence[str], sampler: Resampler) -> dict[str, Draws]:
    """Return resampled metrics by seed."""
    found = {}
    for seed, each in row.runs.items():
        table = paired(first, each.result)[1]
        kept = {name: table.values[name] for name in metrics if name in table.values}
        found[seed] = sampler.draws(replace(table, values=kept), **each.result.averaging)
    return found


def _compute(
    row: Row, reference: Row, basis: Mapping[str, Draws], first: Result, metrics: Sequence[str], sampler: Resampler
) -> None:
    if not row.runs:
        return
    if row is reference:
        draws = dict(basis)
    elif not row.differs:
        draws = _draws(row, first, metrics, sampler)
    else:  # tested on other images; no draws if its seeds differ in them
        own = next(iter(row.runs.values())).result
        same = not any(_differences(own, each.result) for each in row.runs.values())
        like = Resampler(own.table, repeats=sampler.repeats, seed=sampler.seed)
        draws = _draws(row, own, metrics, like) if same else {}
    for name in metrics:
        values = {seed: each.result.metrics.get(name, math.nan) for seed, each in row.runs.items()}
        row.estimates[name] = estimate(name, values, draws)
        if row is not reference and not row.differs and not reference.differs:
            found = contrast(name, values, reference.estimates[name].values, draws, basis)
            row.contrasts |= {name: found} if found else {}


def _undefined(rows: Sequence[Row], metrics: Sequence[str]) -> list[str]:
    """List rows without a mean, since a metric is undefined for one of their seeds."""
    lines = []
    for row in rows:
        gaps: dict[str, list[str]] = {}
        for name in metrics if row.runs else ():
            if seeds := [seed for seed, value in row.estimates[name].values.items() if not math.isfinite(value)]:
                gaps.setdefault(", ".join(seeds), []).append(name)
        lines += [f"'{row.label}' has no {', '.join(gap)}: undefined for seed {seeds}" for seeds, gap in gaps.items()]
    return lines


def _unpaired(rows: Sequence[Row], reference: Row) -> list[str]:
    """List rows whose seeds are not those of the reference."""
    lines = []
    for row in rows:
        shared = [seed for seed in reference.runs if seed in row.runs]
        comparable = row.runs and not row.differs and not reference.differs
        if comparable and len(shared) < max(len(row.runs), len(reference.runs)):
            only = f"are paired by seed {', '.join(shared)} only" if shared else "have no seed in common to pair"
            lines.append(f"'{row.label}' and the reference {only}")
    return lines


def _versions_of(table: Sequence[Row]) -> dict[str, list[str]]:
    """Return the names of the runs that count, by the version of hudepth that trained them."""
    versions: dict[str, list[str]] = {}
    for run in (each.run.path for row in table for each in row.runs.values()):
        try:
            found = read_json(run / "environment.json")["packages"]["hudepth"]
        except (OSError, ValueError, RecursionError, KeyError, TypeError):
            found = None
        versions.setdefault(found if isinstance(found, str) else "unknown", []).append(run.name)
    return versions


def _other_versions(versions: Mapping[str, Sequence[str]], reference: Row) -> list[str]:
    """Return one line on the runs of another version than the reference's first run, if there are any."""
    if len(versions) < 2:
        return []
    own = next(iter(reference.runs.values())).run.path.name
    basis = next(version for version, runs in versions.items() if own in runs)
    others = []
    for version, runs in versions.items():
        if version != basis:
            more = f" and {len(runs) - NAMED} more" if len(runs) > NAMED else ""
            others.append(f"{version}: {', '.join(runs[:NAMED])}{more}")
    return [f"not all runs are of hudepth {basis}, the reference's: {'; '.join(others)}"]
