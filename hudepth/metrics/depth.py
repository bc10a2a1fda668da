"""Depth metrics of the field, in metres, over valid pixels.

With p the prediction, t the truth, N the valid pixels, d = p - t and g = ln p - ln t:

    abs_rel  = 1/N sum |d| / t           (the paper's ARE)
    sq_rel   = 1/N sum d^2 / t           [m]
    mse      = 1/N sum d^2               [m^2]
    rmse     = sqrt(mse)                 [m]
    rmse_log = sqrt(1/N sum g^2)
    log10    = 1/N sum |log10 p - log10 t|
    silog    = factor * sqrt(1/N sum g^2 - lambda * (1/N sum g)^2)
    mae      = 1/N sum |d|               [m]
    delta_k  = share of pixels with max(p/t, t/p) < 1.25^k, k = 1, 2, 3

Sources: Turkmen and Akgun 2025, section 3.5 (abs_rel, mse, log10, delta); Eigen et al. 2014 (sq_rel, rmse,
rmse_log, and silog's radicand; most report silog with lambda 1 and factor 100). In g, log10 and delta a
prediction below :data:`MIN_DEPTH_M` counts as that. All metrics follow from sums over pixels, so the same
formulas serve one image and pixels pooled over many.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from hudepth.masked import full_precision

MIN_DEPTH_M = 1e-3
"""Predictions below this [m] count as this in logarithms and ratios."""

SUM_NAMES = (
    "count", "abs_rel", "sq_rel", "squared", "absolute", "log", "log_squared", "log10", "delta1", "delta2",
    "delta3",
)  # fmt: skip
"""Keys of :func:`depth_sums`."""

METRIC_NAMES = (
    "abs_rel", "sq_rel", "mse", "rmse", "rmse_log", "log10", "silog", "mae", "delta1", "delta2", "delta3",
)  # fmt: skip
"""Keys of :func:`depth_metrics_from_sums`."""


def depth_sums(
    pred_m: Float[Tensor, "b 1 h w"], target_m: Float[Tensor, "b 1 h w"], valid: Bool[Tensor, "b 1 h w"]
) -> dict[str, Float64[Tensor, " b"]]:
    """Sum, over each image's valid pixels, what the metrics are made of.

    Args:
        pred_m: predicted depth [m].
        target_m: ground-truth depth [m], positive where valid; ignored elsewhere.
        valid: True where the truth is measured.

    Returns:
        The sums named in :data:`SUM_NAMES`. Maps are float32 (float64 for float64), their sums float64.
    """
    # 1 m against 1 m where not valid: no error there, so only counts need the mask
    pred = torch.where(valid, full_precision(pred_m), 1.0)
    target = torch.where(valid, full_precision(target_m), 1.0)
    error = (pred - target).abs()
    relative = error / target
    positive = pred.clamp_min(MIN_DEPTH_M)
    ratio = positive / target
    # squared in float64: silog subtracts nearly equal sums if the prediction is off by a constant factor
    log_ratio = ratio.log().double()
    worse = torch.maximum(ratio, target / positive)
    return {
        "count": _total(valid),
        "abs_rel": _total(relative),
        "sq_rel": _total(relative * error),
        "squared": _total(error.square()),
        "absolute": _total(error),
        "log": _total(log_ratio),
        "log_squared": _total(log_ratio.square()),
        "log10": _total(log_ratio.abs()) / math.log(10),
        "delta1": _total((worse < 1.25) & valid),
        "delta2": _total((worse < 1.25**2) & valid),
        "delta3": _total((worse < 1.25**3) & valid),
    }


def depth_metrics_from_sums(
    sums: dict[str, Float64[Tensor, "*b"]], *, silog_lambda: float = 1.0, silog_factor: float = 100.0
) -> dict[str, Float64[Tensor, "*b"]]:
    """Turn sums over pixels into metrics: per image from per-image sums, pooled from pooled ones.

    Args:
        sums: what :func:`depth_sums` returns, or that added up.
        silog_lambda: share of the squared mean log error that is forgiven, in [0, 1].
        silog_factor: scale of silog.

    Returns:
        The metrics named in :data:`METRIC_NAMES`; NaN where the count is 0.
    """
    mean = {name: total / sums["count"] for name, total in sums.items()}
    variance = mean["log_squared"] - silog_lambda * mean["log"].square()
    return {
        "abs_rel": mean["abs_rel"],
        "sq_rel": mean["sq_rel"],
        "mse": mean["squared"],
        "rmse": mean["squared"].sqrt(),
        "rmse_log": mean["log_squared"].sqrt(),
        "log10": mean["log10"],
        "silog": silog_factor * variance.clamp_min(0).sqrt(),  # rounding can leave less than 0
        "mae": mean["absolute"],
        "delta1": mean["delta1"],
        "delta2": mean["delta2"],
        "delta3": mean["delta3"],
    }


def depth_metrics(
    pred_m: Float[Tensor, "b 1 h w"],
    target_m: Float[Tensor, "b 1 h w"],
    valid: Bool[Tensor, "b 1 h w"],
    *,
    silog_lambda: float = 1.0,
    silog_factor: float = 100.0,
) -> dict[str, Float64[Tensor, " b"]]:
    """Metrics of each image: :func:`depth_metrics_from_sums` of :func:`depth_sums`."""
    sums = depth_sums(pred_m, target_m, valid)
    return depth_metrics_from_sums(sums, silog_lambda=silog_lambda, silog_factor=silog_factor)


def _total(x: Tensor) -> Tensor:
    if x.dtype == torch.bool:  # three times faster counted than cast
        return x.sum(dim=(1, 2, 3)).double()
    return x.sum(dim=(1, 2, 3), dtype=torch.float64)
