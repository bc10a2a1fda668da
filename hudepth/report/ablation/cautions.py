"""What a reader of a sweep's table should know before trusting it, one line each."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence

from hudepth.report.ablation.rows import Row

NAMED = 3  # most runs that a line lists by name


def undefined(rows: Sequence[Row], metrics: Sequence[str]) -> list[str]:
    """List rows without a mean, since a metric is undefined for one of their seeds."""
    lines = []
    for row in rows:
        gaps: dict[str, list[str]] = {}
        for name in metrics if row.runs else ():
            if seeds := [seed for seed, value in row.estimates[name].values.items() if not math.isfinite(value)]:
                gaps.setdefault(", ".join(seeds), []).append(name)
        lines += [f"'{row.label}' has no {', '.join(gap)}: undefined for seed {seeds}" for seeds, gap in gaps.items()]
    return lines


def unpaired(rows: Sequence[Row], reference: Row) -> list[str]:
    """List rows whose seeds are not those of the reference."""
    lines = []
    for row in rows:
        shared = [seed for seed in reference.runs if seed in row.runs]
        comparable = row.runs and not row.differs and not reference.differs
        if comparable and len(shared) < max(len(row.runs), len(reference.runs)):
            only = f"are paired by seed {', '.join(shared)} only" if shared else "have no seed in common to pair"
            lines.append(f"'{row.label}' and the reference {only}")
    return lines


def versions_of(table: Sequence[Row]) -> dict[str, list[str]]:
    """Return the names of the runs that count, by the version of hudepth that trained them."""
    versions: dict[str, list[str]] = {}
    for run in (each.run.path for row in table for each in row.runs.values()):
        try:
            found = json.loads((run / "environment.json").read_text(encoding="utf-8"))["packages"]["hudepth"]
        except (OSError, ValueError, RecursionError, KeyError, TypeError):
            found = None
        versions.setdefault(found if isinstance(found, str) else "unknown", []).append(run.name)
    return versions


def other_versions(versions: Mapping[str, Sequence[str]], reference: Row) -> list[str]:
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
