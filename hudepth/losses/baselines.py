"""Standard losses to compare BADCL with: L1, L2, BerHu (Laina et al. 2016), SILog (Eigen et al. 2014).

All are means over the valid pixels of the batch, and 0 where nothing is valid.
"""

from __future__ import annotations

from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from hudepth.base.masked import masked_mean
from hudepth.base.options import Range, convert
from hudepth.base.types import DepthMap, Mask
from hudepth.losses.base import Positive, SingleTermLoss, difference

MIN_UNIT_DEPTH = 1e-3
"""Depths below this count as this under a logarithm: 1 cm at a maximum depth of 10 m."""


def l1_loss(pred: DepthMap, target: DepthMap, valid: Mask) -> Float[Tensor, ""]:
    """Mean absolute error."""
    return masked_mean(difference(pred, target, valid).abs(), valid)


def l2_loss(pred: DepthMap, target: DepthMap, valid: Mask) -> Float[Tensor, ""]:
    """Mean squared error."""
    return masked_mean(difference(pred, target, valid).square(), valid)


def berhu_loss(pred: DepthMap, target: DepthMap, valid: Mask, *, threshold: float = 0.2) -> Float[Tensor, ""]:
    """Reverse Huber: ``|e|`` up to c, ``(e^2 + c^2) / (2 c)`` above (Laina et al. 2016).

    c = ``threshold`` * the largest ``|e|`` among the valid pixels of the batch; no gradient flows through it.
    """
    error = difference(pred, target, valid).abs()
    # tiny: without any error c is 0, and the branch not taken must not divide by it
    c = (threshold * error.detach().amax()).clamp_min(torch.finfo(error.dtype).tiny)
    return masked_mean(torch.where(error <= c, error, (error.square() + c.square()) / (2 * c)), valid)


def log_difference(pred: DepthMap, target: DepthMap, valid: Mask) -> DepthMap:
    """Return ln pred - ln target, 0 where not valid. Depths below :data:`MIN_UNIT_DEPTH` count as that."""
    pred, target = (torch.where(valid, x, 1.0).clamp_min(MIN_UNIT_DEPTH) for x in (pred, target))
    return pred.log() - target.log()


def silog_loss(
    pred: DepthMap, target: DepthMap, valid: Mask, *, variance_focus: float = 0.85, factor: float = 10.0
) -> Float[Tensor, ""]:
    """Scale-invariant error: factor * sqrt(mean(g^2) - variance_focus * mean(g)^2), g = ln pred - ln target.

    Eigen et al. 2014, under a root and with the constants of BTS and AdaBins. Depths below :data:`MIN_UNIT_DEPTH` count
    as that. ``variance_focus`` is in [0, 1]: 0 leaves the RMSE of logs, 1 forgives any common scale.
    """
    g = log_difference(pred, target, valid)
    mean = masked_mean(g, valid)
    # the same as mean(g^2) - variance_focus * mean^2, but a sum of squares: rounding cannot make it negative
    radicand = masked_mean((g - mean).square(), valid) + (1 - variance_focus) * mean.square()
    # the root has no gradient at 0, so it never sees one
    positive = radicand > 0
    return factor * torch.where(positive, torch.where(positive, radicand, 1.0).sqrt(), 0.0)


class L1(SingleTermLoss):
    """:func:`l1_loss` as a module."""

    name = "l1"

    def value(self, pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return :func:`l1_loss`."""
        return l1_loss(pred, target, valid)


class L2(SingleTermLoss):
    """:func:`l2_loss` as a module."""

    name = "l2"

    def value(self, pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return :func:`l2_loss`."""
        return l2_loss(pred, target, valid)


class BerHu(SingleTermLoss):
    """:func:`berhu_loss` as a module; ``threshold``: c as a fraction of the largest error, in (0, 1]."""

    name = "berhu"

    def __init__(self, *, threshold: float = 0.2) -> None:
        super().__init__()
        self.threshold = convert("loss.threshold", threshold, Annotated[float, Range(0, 1, above=True)], default=0.2)

    def value(self, pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return :func:`berhu_loss`."""
        return berhu_loss(pred, target, valid, threshold=self.threshold)


class SILog(SingleTermLoss):
    """:func:`silog_loss` as a module; ``variance_focus`` is in [0, 1], ``factor`` positive."""

    name = "silog"

    def __init__(self, *, variance_focus: float = 0.85, factor: float = 10.0) -> None:
        super().__init__()
        share = Annotated[float, Range(0, 1)]
        self.variance_focus = convert("loss.variance_focus", variance_focus, share, default=0.85)
        self.factor = convert("loss.factor", factor, Positive, default=10.0)

    def value(self, pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return :func:`silog_loss`."""
        return silog_loss(pred, target, valid, variance_focus=self.variance_focus, factor=self.factor)
