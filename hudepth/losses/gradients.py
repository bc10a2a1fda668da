"""Gradient matching at several scales (Li and Snavely, CVPR 2018; MiDaS, Ranftl et al. 2022).

With R = ln D^ - ln D::

    L = sum over scales k of mean(|R_x| + |R_y|) at every 2^k-th pixel
"""

from __future__ import annotations

from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from hudepth.base.masked import masked_mean
from hudepth.base.options import Range, convert
from hudepth.base.types import DepthMap, Mask
from hudepth.losses.base import SingleTermLoss
from hudepth.losses.baselines import log_difference


def gradient_matching_loss(pred: DepthMap, target: DepthMap, valid: Mask, *, scales: int = 4) -> Float[Tensor, ""]:
    """Mean over valid neighbours of how much the log ratio of prediction and ground truth changes, summed over scales.

    It ignores a scale factor per image, and penalises edges that are missing, blurred or spurious. Both maps are unit
    depth; a difference counts where both its pixels are valid. ``scales``: 1 compares neighbours, 2 also every second
    pixel with the next second pixel, and so on.
    """
    ratio = log_difference(pred, target, valid)
    total = 0 * ratio.sum()  # an image of one pixel has no neighbours, but a gradient
    for k in range(scales):
        step = 2**k
        part, measured = ratio[..., ::step, ::step], valid[..., ::step, ::step]
        for dim in (-1, -2):
            if part.shape[dim] < 2:
                continue
            pairs = measured.narrow(dim, 1, part.shape[dim] - 1) & measured.narrow(dim, 0, part.shape[dim] - 1)
            total = total + masked_mean(torch.diff(part, dim=dim).abs(), pairs)
    return total


class GradientMatching(SingleTermLoss):
    """:func:`gradient_matching_loss` as a module, on at least one scale."""

    name = "gradient"

    def __init__(self, *, scales: int = 4) -> None:
        super().__init__()
        self.scales = convert("loss.scales", scales, Annotated[int, Range(1, 16)], default=4)

    def value(self, pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return :func:`gradient_matching_loss`."""
        return gradient_matching_loss(pred, target, valid, scales=self.scales)
