"""How far an axis reaches, so that one value far out does not press all others into a line."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable

FAR = 12.0
"""A value is far out if it lies so many times further from the middle than half of the values do."""


def usual_range(values: Iterable[float]) -> tuple[float, float]:
    """Return the smallest and the largest of the finite values that are not far out.

    Returns:
        (0, 1) if there is none.
    """
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return 0.0, 1.0
    middle = statistics.median(known)
    spread = statistics.median(abs(value - middle) for value in known)
    kept = [value for value in known if abs(value - middle) <= FAR * spread] if spread else known
    return min(kept), max(kept)
