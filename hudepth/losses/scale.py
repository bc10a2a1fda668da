"""A loss of the scale of whole depth maps."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hudepth.base.masked import masked_sum
from hudepth.base.types import DepthMap, Mask
from hudepth.losses.base import SingleTermLoss
from hudepth.losses.baselines import log_difference


def image_scale_loss(pred: DepthMap, target: DepthMap, valid: Mask) -> Float[Tensor, ""]:
    """Mean over images of abs(mean(ln pred - ln target)): how far off each map is as a whole; 0 if nothing is valid.

    :func:`hudepth.losses.baselines.silog_loss` forgives a part of the mean over a batch. What its images are off by on
    average is a part of the error that a depth map shares with all its pixels.
    """
    count = masked_sum(torch.ones_like(pred), valid, dim=(1, 2, 3))
    off = masked_sum(log_difference(pred, target, valid), valid, dim=(1, 2, 3)).abs() / count.clamp_min(1)
    return off.sum() / (count > 0).sum().clamp_min(1)


class ImageScale(SingleTermLoss):
    """:func:`image_scale_loss` as a module."""

    name = "image_scale"

    def value(self, pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return :func:`image_scale_loss`."""
        return image_scale_loss(pred, target, valid)
