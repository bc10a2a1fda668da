"""Structural similarity (Wang et al. 2004; Turkmen and Akgun 2025, section 3.5.1)::

    SSIM = (2 mu_p mu_t + C1) (2 cov_pt + C2) / ((mu_p^2 + mu_t^2 + C1) (var_p + var_t + C2))
    C1 = (k1 L)^2,  C2 = (k2 L)^2,  L = data range

Means, variances and the covariance are weighted by a Gaussian window, by default 11 x 11 with sigma 1.5. No
window reaches over the border, as in scikit-image; torchmetrics also counts windows over a reflected border.
Values compare only at the same window and data range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from hudepth.base.errors import ConfigError
from hudepth.base.masked import full_precision, masked_sum, widen
from hudepth.base.types import DepthMap, Mask


def ssim_map(
    pred: DepthMap,
    target: DepthMap,
    *,
    data_range: float,
    window: int = 11,
    sigma: float = 1.5,
    k1: float = 0.01,
    k2: float = 0.03,
) -> Float[Tensor, "b 1 rows columns"]:
    """SSIM of each window, rows = h - window + 1, columns = w - window + 1; both maps and ``data_range`` in one unit.

    Computed in float32 (float64 for float64) whatever autocast says: bfloat16 is off by 2e-3. Window and sigma are in
    pixels. Raises ConfigError if the images are smaller than the window.
    """
    _check_size(pred, window)
    with torch.autocast(pred.device.type, enabled=False):
        # variances are differences of nearly equal squares: centring the values keeps those small
        shift = data_range / 2
        p, t = full_precision(pred) - shift, full_precision(target) - shift
        moments = window_sum(torch.cat([p, t, p * p + t * t, p * t], dim=1), gaussian(window, sigma))
        mean_p, mean_t, squares, product = moments.unbind(dim=1)
        var = squares - mean_p * mean_p - mean_t * mean_t
        cov = product - mean_p * mean_t
        mean_p, mean_t = mean_p + shift, mean_t + shift
        c1, c2 = (k1 * data_range) ** 2, (k2 * data_range) ** 2
        means = (2 * mean_p * mean_t + c1) / (mean_p * mean_p + mean_t * mean_t + c1)
        return (means * (2 * cov + c2) / (var + c2)).unsqueeze(1)


def ssim(
    pred: DepthMap,
    target: DepthMap,
    valid: Mask | None = None,
    *,
    data_range: float,
    window: int = 11,
    sigma: float = 1.5,
    k1: float = 0.01,
    k2: float = 0.03,
) -> Float[Tensor, " b"]:
    """Mean of :func:`ssim_map` over windows whose pixels are all ``valid`` (None: all); NaN for an image without one.

    Further arguments and errors are those of :func:`ssim_map`.
    """
    if valid is None:
        valid = torch.ones_like(target, dtype=torch.bool)
    total, windows = ssim_sums(pred, target, valid, data_range=data_range, window=window, sigma=sigma, k1=k1, k2=k2)
    return (total / windows).to(full_precision(pred).dtype)


def ssim_sums(
    pred: DepthMap,
    target: DepthMap,
    valid: Mask,
    *,
    data_range: float,
    window: int = 11,
    sigma: float = 1.5,
    k1: float = 0.01,
    k2: float = 0.03,
) -> tuple[Float[Tensor, " b"], Int64[Tensor, " b"]]:
    """Sum of :func:`ssim_map` over each image's windows whose pixels are all valid, and how many there are."""
    pred, target = torch.where(valid, pred, 0.0), torch.where(valid, target, 0.0)
    values = ssim_map(pred, target, data_range=data_range, window=window, sigma=sigma, k1=k1, k2=k2)
    whole = whole_windows(valid, window)
    return widen(masked_sum(values, whole, dim=(1, 2, 3)).flatten()), whole.sum(dim=(1, 2, 3))


def whole_windows(valid: Mask, window: int) -> Bool[Tensor, "b 1 rows columns"]:
    """Tell of each window, in the order of :func:`ssim_map`, whether all its pixels are valid."""
    return window_sum(valid.float(), [1.0] * window) == window**2


def gaussian(window: int, sigma: float) -> list[float]:
    """Weights of a centred Gaussian over ``window`` pixels; they add up to 1."""
    weights = [math.exp(-((i - (window - 1) / 2) ** 2) / (2 * sigma**2)) for i in range(window)]
    return [weight / sum(weights) for weight in weights]


def window_sum(x: Float[Tensor, "b c h w"], weights: Sequence[float]) -> Float[Tensor, "b c rows columns"]:
    """Weighted sum over each square window, with the same ``weights`` along rows and columns.

    On a CPU OpenCV filters four times faster than torch can add shifted views. Elsewhere, or if a gradient or float64
    is wanted, adding views is over 20 times faster than convolving one channel, and never in TF32.
    """
    if x.device.type == "cpu" and x.dtype == torch.float32 and not (torch.is_grad_enabled() and x.requires_grad):
        return _filtered(x, weights)
    for dim in (-1, -2):
        size = x.shape[dim] - len(weights) + 1
        total = x.narrow(dim, 0, size) * weights[0]
        for offset, weight in enumerate(weights[1:], start=1):
            total.add_(x.narrow(dim, offset, size), alpha=weight)
        x = total
    return x


def _filtered(x: Tensor, weights: Sequence[float]) -> Tensor:
    kernel, size = np.array(weights, np.float32), len(weights)
    b, c, h, w = x.shape
    result = np.empty((b * c, h - size + 1, w - size + 1), np.float32)
    for plane, target in zip(x.detach().flatten(0, 1).numpy(), result, strict=True):
        full = cv2.sepFilter2D(plane, cv2.CV_32F, kernel, kernel, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
        target[:] = full[: h - size + 1, : w - size + 1]
    return torch.from_numpy(result).reshape(b, c, *result.shape[1:])


def _check_size(image: Tensor, window: int) -> None:
    height, width = image.shape[-2:]
    if min(height, width) < window:
        raise ConfigError(
            f"ssim: a {height} x {width} image has no window of {window} x {window} pixels. "
            f"Use images of at least {window} x {window}."
        )
