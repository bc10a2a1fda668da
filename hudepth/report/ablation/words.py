"""Numbers and sentences of a sweep's table, the same in every form of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hudepth.metrics.catalogue import metric_info
from hudepth.report.ablation.estimates import BETTER, NOT_SHOWN, WORSE, Interval
from hudepth.report.ablation.report import NAMED, Report
from hudepth.report.ablation.rows import Row

MOST_PLACES = 7


def places(report: Report) -> dict[str, int]:
    """Return the decimals of each metric: 4, 2 for large ones, more if the largest mean has leading zeros."""
    digits = {}
    for name in report.metrics:
        means = (abs(row.estimates[name].mean) for row in report.rows if row.estimates)
        largest = max(filter(math.isfinite, means), default=0.0) or 1.0
        digits[name] = 2 if largest >= 10 else min(MOST_PLACES, max(4, 3 - math.floor(math.log10(largest))))
    return digits


def number(value: float, digits: int, *, sign: bool = False) -> str:
    """Return a number with so many decimals; ``-`` if it is not finite."""
    return f"{value:{'+' if sign else ''}.{digits}f}" if math.isfinite(value) else "-"


def between(interval: Interval, digits: int, *, sign: bool = False) -> str:
    """Return ``0.21 to 0.24``; empty if there is no interval."""
    return " to ".join(number(x, digits, sign=sign) for x in (interval.low, interval.high) if interval.known)


def half_width(interval: Interval, digits: int) -> str:
    """Return ``±0.01`` for a symmetric interval; empty if there is none."""
    return f"±{number((interval.high - interval.low) / 2, digits)}" if interval.known else ""


def heading(name: str) -> str:
    """Return a metric's name, its unit, and which way is better."""
    return f"{metric_info(name).label} {metric_info(name).arrow}"


def about(report: Report) -> str:
    """Return in one line what was tested on what."""
    split, data, scenes = report.first.split, report.first.data, report.uncertainty["scenes"]
    images = len(report.first.table.ids)
    where = f"{scenes} scenes" if any(report.first.table.scenes) else "no scenes named"
    return f"{report.protocol} protocol, {images} test images ({where}) of {data['source']}, {split['kind']} split"


def finding(report: Report) -> str:
    """Return in a few sentences how the rows compare with the reference, in the first metric."""
    name, reference = report.metrics[0], report.reference
    digits, compared = places(report)[name], [row for row in report.rows if name in row.contrasts]
    mean = number(reference.estimates[name].mean, digits) if name in reference.estimates else "-"
    if not compared:
        return f"{reference.label} has {name} {mean}; there is no other row to compare it with."
    groups: dict[str, list[Row]] = {BETTER: [], WORSE: [], NOT_SHOWN: []}
    for row in sorted(compared, key=lambda row: -abs(row.contrasts[name].value)):
        groups[row.contrasts[name].verdict].append(row)

    def listed(rows: Sequence[Row]) -> str:
        shown = ", ".join(f"{row.label} ({number(row.estimates[name].mean, digits)})" for row in rows[:NAMED])
        return shown + (f" and {len(rows) - NAMED} more" if len(rows) > NAMED else "")

    better = groups[BETTER]
    lines = [f"{listed(better) or 'No row'} {_is(better)} better than {reference.label} ({mean}) in {name}."]
    if worse := groups[WORSE]:
        lines.append(f"{listed(worse)} {_is(worse)} worse.")
    if same := groups[NOT_SHOWN]:
        lines.append(f"For {listed(same)} no difference is shown.")
    return " ".join(lines)


def _is(rows: Sequence[Row]) -> str:
    return "are" if len(rows) > 1 else "is"


def seeds(report: Report) -> str:
    """Return how many seeds rows have: ``3 seeds``, ``1 to 3 seeds``."""
    counts = [len(row.runs) for row in report.rows if row.runs]
    low, high = min(counts), max(counts)
    return f"{low} seed{'s' * (low != 1)}" if low == high else f"{low} to {high} seeds"


def method(report: Report) -> str:
    """Return how the intervals were computed, and when a difference is called better or worse."""
    return (
        "95 % intervals, each metric and row by itself: over seeds by Student's t, over scenes by an expanded "
        f"percentile bootstrap of the mean over seeds ({report.uncertainty['repeats']} draws, the same for all rows). "
        f"Differences from {report.reference.label} are paired by seed and by image. Better or worse: every interval "
        "there is excludes 0."
    )
