"""Gradient matching at several scales (Li and Snavely, CVPR 2018; MiDaS, Ranftl et al. 2022).

R = ln D^ - ln D        L = sum over scales k of mean(|R_x| + |R_y|) at every 2^k-th pixel
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hudepth.base.errors import ConfigError
from hudepth.base.masked import masked_mean
from hudepth.losses.baselines import SingleTermLoss, log_difference


def gradient_matching_loss(
    pred: Float[Tensor, "b 1 h w"],
    target: Float[Tensor, "b 1 h w"],
    valid: Bool[Tensor, "b 1 h w"],
    *,
    scales: int = 4,
) -> Float[Tensor, ""]:
    """Mean over valid neighbours of how much the log ratio of prediction and truth changes, summed over scales.

    It is blind to one scale factor for an image, and sees an edge that is missing, blurred or made up.

    Args:
        pred: unit depth.
        target: unit depth; ignored where not valid.
        valid: True where the truth is measured; a difference counts where both its pixels are.
        scales: 1 compares neighbours, 2 also every second pixel with the next second pixel, and so on.
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
    """:func:`gradient_matching_loss` as a module.

    Args:
        scales: at least 1.

    Raises:
        ConfigError: if ``scales`` is less.
    """

    name = "gradient"

    def __init__(self, *, scales: int = 4) -> None:
        super().__init__()
        if scales < 1:
            raise ConfigError(f"loss.scales: {scales} is less than 1. The usual value is 4.")
        self.scales = scales

    def value(self, pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return :func:`gradient_matching_loss`."""
        return gradient_matching_loss(pred, target, valid, scales=self.scales)
