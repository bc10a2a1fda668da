"""A sweep's table for programs: table.csv and document.json, all numbers with all their digits."""

from __future__ import annotations

import csv
import io
import math
from typing import Any

from hudepth.report.ablation.estimates import Contrast, Estimate, Interval
from hudepth.report.ablation.factors import config_differences
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.row import Row
from hudepth.runs.sweeps import Sweep

PARTS = (
    "", "_seeds_low", "_seeds_high", "_scenes_low", "_scenes_high", "_best",
    "_difference", "_difference_seeds_low", "_difference_seeds_high", "_difference_scenes_low",
    "_difference_scenes_high", "_paired_seeds", "_verdict",
)  # fmt: skip
"""What follows a metric's name in the columns of table.csv."""


def table_csv(report: Report) -> str:
    """Return table.csv: a row a row, empty cells where there is no number."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    factors = [_free(factor.name) for factor in report.factors]
    writer.writerow(
        ["row", *factors, "reference", "seeds", "seeds_tried", "differs"]
        + [f"{name}{part}" for name in report.metrics for part in PARTS]
    )
    for row in report.rows:
        cells = [row.label, *row.variant.factors, _truth(row.is_reference), len(row.runs), len(row.variant.seeds)]
        writer.writerow([*cells, "; ".join(row.differs), *(x for name in report.metrics for x in _cells(row, name))])
    return text.getvalue()


def _free(name: str) -> str:
    return f"factor_{name}" if name in ("row", "reference", "seeds", "seeds_tried", "differs") else name


def _truth(value: bool) -> str:
    return "true" if value else "false"


def _cells(row: Row, name: str) -> list[str]:
    found, difference = row.estimates.get(name), row.contrasts.get(name)
    if found is None:
        return [""] * len(PARTS)
    cells = [_digits(x) for x in (found.mean, *_ends(found.seeds), *_ends(found.scenes))] + [_truth(name in row.best)]
    if difference is None:
        return cells + [""] * (len(PARTS) - len(cells))
    numbers = (difference.value, *_ends(difference.seeds), *_ends(difference.scenes))
    return [*cells, *(_digits(x) for x in numbers), str(len(difference.paired)), difference.verdict]


def _digits(value: float) -> str:
    return repr(float(value)) if math.isfinite(value) else ""


def _ends(interval: Interval) -> tuple[float, float]:
    return interval.low, interval.high


def document(report: Report, sweep: Sweep) -> dict[str, Any]:
    """Return document.json: everything a report says, null where there is no number."""
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
    return {
        "mean": _finite(found.mean),
        "by_seed": {seed: _finite(value) for seed, value in found.values.items()},
        "seeds": _pair(found.seeds),
        "scenes": _pair(found.scenes),
        "best": best,
    }


def _contrast(found: Contrast) -> dict[str, Any]:
    return {
        "value": _finite(found.value),
        "seeds": _pair(found.seeds),
        "scenes": _pair(found.scenes),
        "paired_seeds": found.paired,
        "verdict": found.verdict,
    }


def _pair(interval: Interval) -> list[float | None] | None:
    return [_finite(interval.low), _finite(interval.high)] if interval.known else None


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
