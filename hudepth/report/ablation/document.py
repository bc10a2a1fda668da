"""A sweep's table for programs: table.csv and document.json, with all digits of all numbers."""

from __future__ import annotations

import math
from typing import Any

from hudepth.base.tables import Table
from hudepth.report.ablation.estimates import Contrast, Estimate, Interval
from hudepth.report.ablation.factors import config_differences
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.rows import Row
from hudepth.runs.sweeps import Sweep

PARTS = (
    "", "_seeds_low", "_seeds_high", "_scenes_low", "_scenes_high", "_best",
    "_difference", "_difference_seeds_low", "_difference_seeds_high", "_difference_scenes_low",
    "_difference_scenes_high", "_paired_seeds", "_verdict",
)  # fmt: skip
"""What follows a metric's name in the columns of table.csv."""
OWN = ("row", "reference", "seeds", "seeds_tried", "differs")
"""Columns whose names no factor may take."""


def table_csv(report: Report) -> str:
    """Return table.csv: one row per variant, empty cells where there is no number."""
    factors = [f"factor_{factor.name}" if factor.name in OWN else factor.name for factor in report.factors]
    numbers = [f"{name}{part}" for name in report.metrics for part in PARTS]
    table = Table(["row", *factors, *OWN[1:], *numbers])
    for row in report.rows:
        counts = (str(row.is_reference).lower(), str(len(row.runs)), str(len(row.variant.seeds)))
        cells = (cell for name in report.metrics for cell in _cells(row, name))
        table.add(row.label, *row.variant.factors, *counts, "; ".join(row.differs), *cells)
    return table.to_csv()


def _cells(row: Row, name: str) -> list[str]:
    found, difference = row.estimates.get(name), row.contrasts.get(name)
    if found is None:
        return [""] * len(PARTS)
    cells = [*_digits(found.mean, found.seeds, found.scenes), str(name in row.best).lower()]
    if difference is None:
        return cells + [""] * (len(PARTS) - len(cells))
    numbers = _digits(difference.value, difference.seeds, difference.scenes)
    return [*cells, *numbers, str(len(difference.paired)), difference.verdict]


def _digits(value: float, seeds: Interval, scenes: Interval) -> list[str]:
    numbers = (value, seeds.low, seeds.high, scenes.low, scenes.high)
    return [repr(float(x)) if math.isfinite(x) else "" for x in numbers]


def document(report: Report, sweep: Sweep) -> dict[str, Any]:
    """Return document.json: everything in a report, null where there is no number."""
    return {
        "sweep": str(sweep.folder),
        "protocol": report.first.stamp,
        "data": report.first.data,
        "split": report.first.split,
        "images": len(report.first.table.ids),
        "uncertainty": {"scenes": report.uncertainty, "seeds": {"method": "Student's t", "level": 0.95}},
        "versions": report.versions,
        "reference": report.reference.label,
        "metrics": report.metrics,
        "factors": [{"name": factor.name, "key": factor.key, "values": factor.values} for factor in report.factors],
        "rows": [_row(row, report) for row in report.rows],
        "not_counted": [vars(trouble) for trouble in report.troubles],
        "warnings": report.warnings,
        "notes": sweep.notes,
    }


def _row(row: Row, report: Report) -> dict[str, Any]:
    changes = config_differences(report.reference.variant.config, row.variant.config)
    return {
        "label": row.label,
        "variant": row.variant.named or None,
        "factors": dict(zip((factor.name for factor in report.factors), row.variant.factors, strict=True)),
        "config_differences": {key: {"reference": before, "here": after} for key, before, after in changes},
        "seeds_tried": row.variant.seeds,
        "runs": {seed: str(each.run.path) for seed, each in row.runs.items()},
        "differs": row.differs,
        "metrics": {name: _estimate(each, name in row.best) for name, each in row.estimates.items()},
        "differences": {name: _contrast(each) for name, each in row.contrasts.items()},
    }


def _estimate(found: Estimate, best: bool) -> dict[str, Any]:
    by_seed = {seed: _finite(value) for seed, value in found.values.items()}
    ends = {"seeds": _ends(found.seeds), "scenes": _ends(found.scenes)}
    return {"mean": _finite(found.mean), "by_seed": by_seed, **ends, "best": best}


def _contrast(found: Contrast) -> dict[str, Any]:
    ends = {"seeds": _ends(found.seeds), "scenes": _ends(found.scenes)}
    return {"value": _finite(found.value), **ends, "paired_seeds": found.paired, "verdict": found.verdict}


def _ends(interval: Interval) -> list[float | None] | None:
    return [_finite(interval.low), _finite(interval.high)] if interval.known else None


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
