"""Limits of an axis that one outlier does not stretch until all other values fall on a line."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable

FAR = 12.0
"""A value is far out if its distance from the median exceeds this many times the median distance."""


def usual_range(values: Iterable[float]) -> tuple[float, float]:
    """Return the smallest and the largest of the finite values that are not far out; (0, 1) if there is none."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return 0.0, 1.0
    middle = statistics.median(known)
    spread = statistics.median(abs(value - middle) for value in known)
    kept = [value for value in known if abs(value - middle) <= FAR * spread] if spread else known
    return min(kept), max(kept)
