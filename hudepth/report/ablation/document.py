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
OWN = ("row", "reference", "seeds", "seeds_tried", "differs")  # columns whose names no factor may take


def table_csv(report: Report) -> str:
    """Return table.csv: one row per variant, empty cells where there is no number."""
    factors = [f"factor_{factor.name}" if factor.name in OWN else factor.name for factor in report.factors]
    numbers = [f"{name}{part}" for name in report.metrics for part in PARTS]
    table = Table(["row", *factors, *OWN[1:], *numbers])
    for row in report.rows:
        counts = (str(row.is_reference).lower(), str(len(row.runs)), str(len(row.seeds)))
        cells = (cell for name in report.metrics for cell in _cells(row, name))
        table.add(row.label, *row.factors, *counts, "; ".join(row.differs), *cells)
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
    changes = config_differences(report.reference.config, row.config)
    return {
        "label": row.label,
        "variant": row.named or None,
        "factors": dict(zip((factor.name for factor in report.factors), row.factors, strict=True)),
        "config_differences": {key: {"reference": before, "here": after} for key, before, after in changes},
        "seeds_tried": row.seeds,
        "runs": {seed: str(each.run.path) for seed, each in row.runs.items()},
        "differs": row.differs,
        "metrics": {
            name: _rename(each, values="by_seed") | {"best": name in row.best} for name, each in row.estimates.items()
        },
        "differences": {name: _rename(each, paired="paired_seeds") for name, each in row.contrasts.items()},
    }


def _rename(found: Estimate | Contrast, **names: str) -> dict[str, Any]:
    return {names.get(key, key): _plain(value) for key, value in vars(found).items()}


def _plain(value: Any) -> Any:
    """Return numbers that are not finite, and intervals that there are not, as null."""
    if isinstance(value, Interval):
        return [_plain(value.low), _plain(value.high)] if value.known else None
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
