"""Learning from a teacher's depths: as metres, or up to a scale and a shift (MiDaS, Ranftl et al. 2022)."""

from __future__ import annotations

from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.masked import full_precision, masked_mean, masked_sum
from hudepth.base.options import Choice, convert
from hudepth.base.types import DepthMap, Mask
from hudepth.losses.base import Positive
from hudepth.losses.baselines import MIN_UNIT_DEPTH, log_difference

KINDS = ("metric", "affine_depth", "affine_inverse")
"""Values a teacher may have: metres; depth, or inverse depth (disparity), up to scale and shift."""


def normalised_by_mean(x: DepthMap, valid: Mask, *, eps: float = 1e-6) -> DepthMap:
    """Return (x - mean) / mean absolute deviation over the valid pixels of each image; 0 where not valid.

    (Equation 5 of Ranftl et al. 2022, with the mean in the median's place, which is as blind to scale and shift.)
    """
    count = masked_sum(torch.ones_like(x), valid, dim=(1, 2, 3)).clamp_min(1)
    centred = torch.where(valid, x - masked_sum(x, valid, dim=(1, 2, 3)) / count, 0.0)
    return centred / (centred.abs().sum(dim=(1, 2, 3), keepdim=True) / count + eps)


def affine_invariant_loss(pred: DepthMap, teacher: DepthMap, valid: Mask) -> Float[Tensor, ""]:
    """Mean absolute difference after each image of both was brought to mean 0 and mean absolute deviation 1."""
    return masked_mean((normalised_by_mean(pred, valid) - normalised_by_mean(teacher, valid)).abs(), valid)


class Distillation(nn.Module):
    """The distance from a teacher's depths, times a weight; added to the loss of the ground truth.

    ``kind`` is one of :data:`KINDS`, of which ``metric`` compares logarithms of depth; ``weight`` is positive. Raises
    ConfigError for others.
    """

    def __init__(self, *, kind: str = "metric", weight: float = 1.0) -> None:
        super().__init__()
        self.kind = convert("distill.kind", kind, Annotated[str, Choice(KINDS)])
        self.weight = convert("distill.weight", weight, Positive, default=1.0)

    def forward(self, pred: DepthMap, teacher: DepthMap) -> Float[Tensor, ""]:
        """Return the distance, before its weight.

        ``pred`` is unit depth; ``teacher`` is unit depth if the kind is ``metric``, else the teacher's values; 0 where
        it has none.
        """
        valid = teacher > 0
        with torch.autocast(pred.device.type, enabled=False):
            pred = full_precision(pred)
            if self.kind == "metric":
                return masked_mean(log_difference(pred, teacher, valid).abs(), valid)
            if self.kind == "affine_inverse":
                pred = 1 / pred.clamp_min(MIN_UNIT_DEPTH)
            return affine_invariant_loss(pred, teacher, valid)
