"""What a reader of a sweep's table should know before trusting it, one line each."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from hudepth.report.ablation.rows import Row

UNKNOWN = "unknown"
NAMED = 3
"""Most runs that a line lists by name."""


def undefined(table: Sequence[Row], metrics: Sequence[str]) -> list[str]:
    """List rows without a mean, since a metric is undefined for one of their seeds."""
    lines = []
    for row in table:
        gaps: dict[str, list[str]] = {}
        for name in metrics:
            values = row.estimates[name].values if row.runs else {}
            lacking = [seed for seed, value in values.items() if not math.isfinite(value)]
            if lacking:
                gaps.setdefault(", ".join(lacking), []).append(name)
        lines += [
            f"'{row.label}' has no {', '.join(names)}: undefined for seed {seeds}" for seeds, names in gaps.items()
        ]
    return lines


def unpaired(table: Sequence[Row], reference: Row) -> list[str]:
    """List rows whose seeds are not those of the reference."""
    lines = []
    for row in table:
        if row is reference or not row.runs or row.differs or reference.differs:
            continue
        shared = [seed for seed in reference.runs if seed in row.runs]
        if len(shared) < max(len(row.runs), len(reference.runs)):
            only = f"are paired by seed {', '.join(shared)} alone" if shared else "have no seed in common to pair"
            lines.append(f"'{row.label}' and the reference {only}")
    return lines


def versions_of(table: Sequence[Row]) -> dict[str, list[str]]:
    """Return the names of the runs that count, by the version of hudepth that trained them."""
    versions: dict[str, list[str]] = {}
    for row in table:
        for each in row.runs.values():
            versions.setdefault(_version(each.run.path), []).append(each.run.path.name)
    return versions


def other_versions(versions: Mapping[str, Sequence[str]], reference: Row) -> list[str]:
    """Return one line on the runs of another version than the reference's first run, if there are any."""
    if len(versions) < 2:
        return []
    own = next(iter(reference.runs.values())).run.path.name
    basis = next(version for version, runs in versions.items() if own in runs)
    others = "; ".join(f"{version}: {_some(runs)}" for version, runs in versions.items() if version != basis)
    return [f"not all runs are of hudepth {basis}, the reference's: {others}"]


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _version(run: Path) -> str:
    try:
        found = json.loads((run / "environment.json").read_text(encoding="utf-8"))["packages"]["hudepth"]
    except (OSError, ValueError, RecursionError, KeyError, TypeError):
        return UNKNOWN
    return found if isinstance(found, str) else UNKNOWN
