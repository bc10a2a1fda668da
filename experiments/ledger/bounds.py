"""What error figures allow one another: bounds that hold for any data, any model and any averaging over images.

Let ground truth t and prediction p lie in (0, D], and let q = max(p/t, t/p), d = |p - t|, r = d / t. Where q < Q:

    d <= D (1 - 1/Q)        the larger of p and t is at most D, the smaller at least 1/Q of it
    d^2 = d t r <= D^2 (1 - 1/Q) r
    |log10 p/t| <= log10 Q,  and at most  log10 Q / (1 - 1/Q)  times r

delta_k gives the share of pixels with q < 1.25^k, abs_rel the mean of r. The largest possible mean of d^2 follows by
spending r where it buys most: in the widest class first. Means over images of per-image figures obey the same bounds,
since the mean of roots is at most the root of the mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

THRESHOLDS = (1.25, 1.25**2, 1.25**3)
MIN_DEPTH_M = 1e-3
"""Predictions below it count as this in logarithms."""


def shares(deltas: Sequence[float]) -> list[float]:
    """Return the shares of pixels in each class: within 1.25, up to 1.25^2, up to 1.25^3, beyond.

    A negative share means that the deltas fall where they must rise.
    """
    return [high - low for low, high in pairwise([0.0, *deltas, 1.0])]


def rising(deltas: Sequence[float]) -> bool:
    """Tell whether delta1 <= delta2 <= delta3 <= 1: a pixel within a threshold is within the next."""
    return all(share >= 0 for share in shares(deltas))


def largest_rmse_m(abs_rel: float, deltas: Sequence[float], *, max_depth_m: float, rounding: float = 0.0005) -> float:
    """Return the largest RMSE [m] that goes with an abs_rel and deltas where depth is at most ``max_depth_m``.

    Args:
        abs_rel: mean relative error.
        deltas: delta1 to delta3, rising.
        max_depth_m: D, of ground truth and prediction.
        rounding: half the last printed digit, given in favour of the printed figures.
    """
    budget, total = abs_rel + rounding, 0.0
    *inside, beyond = shares(_widened(deltas, rounding))
    caps = [1 - 1 / threshold for threshold in THRESHOLDS]
    for share, cap in ((beyond, 1.0), *reversed(list(zip(inside, caps, strict=True)))):
        spent = min(share * cap, budget)  # r at which d^2 reaches its largest value in this class
        total += max_depth_m**2 * cap * spent
        budget -= spent
    return math.sqrt(total)


def largest_log10(abs_rel: float, deltas: Sequence[float], *, max_depth_m: float, rounding: float = 0.0005) -> float:
    """Return the largest log10 error that goes with an abs_rel and deltas; arguments as :func:`largest_rmse_m`."""
    *inside, beyond = shares(_widened(deltas, rounding))
    budget = abs_rel + rounding
    total = beyond * math.log10(max_depth_m / MIN_DEPTH_M)  # and none of the budget: a bound all the same
    for share, threshold in reversed(list(zip(inside, THRESHOLDS, strict=True))):
        cap = 1 - 1 / threshold
        spent = min(share * cap, budget)
        total += spent * math.log10(threshold) / cap
        budget -= spent
    return total


def _widened(deltas: Sequence[float], rounding: float) -> list[float]:
    return [max(0.0, delta - rounding) for delta in deltas]


def largest_mean_depth_m(loss: float, *, abs_rel: float, boundary: float, max_depth_m: float) -> float:
    """Return the largest mean depth [m] at which a BADCL value and an abs_rel go together.

    The boundary term alone is at least the mean absolute error, since its weights are exponentials of something not
    negative: loss >= boundary * mean(d) / D = boundary * abs_rel * T / D, with T the mean depth weighted by relative
    error. Solved for T.

    Args:
        loss: total loss, on depth / ``max_depth_m``.
        abs_rel: mean relative error.
        boundary: weight of the boundary term.
        max_depth_m: D.
    """
    return loss / (boundary * abs_rel) * max_depth_m
