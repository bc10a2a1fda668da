"""A loss of how well depth edges are predicted: the F1 score of edge pixels, made differentiable."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hudepth.base.masked import masked_sum
from hudepth.base.options import convert
from hudepth.base.sobel import squared_sobel, whole_neighbourhoods
from hudepth.base.types import DepthMap, Mask
from hudepth.losses.base import Positive, SingleTermLoss

_SOFTNESS = 0.25
"""Width of the transition from no edge to an edge, as a share of the threshold."""
_FLAT = 1e-12
"""Added to squared slopes: the slope of a root is infinite at 0."""


def edge_overlap_loss(pred: DepthMap, target: DepthMap, valid: Mask, *, threshold: float = 0.1) -> Float[Tensor, ""]:
    """1 - F1 of predicted edge pixels, averaged over the images that have edges; 0 if none has.

    F1 = 2 hits / (predicted + true), as in :func:`hudepth.metrics.boundary.edge_scores` (Hu et al. 2019), with soft
    counts (Dice loss, Milletari et al. 2016). With s the 3 x 3 Sobel magnitude of unit depth, a true edge is where that
    of the ground truth is above ``threshold``, and one is predicted to the degree sigmoid(4 (s / threshold - 1)). A
    step of unit depth by d gives 4 d: at 0.1 and 10 m, steps of 25 cm count.

    Other losses blur an edge the more the less sure its place is; this one makes it steep or leaves it out.
    """
    whole = whole_neighbourhoods(valid)
    steep, true = (squared_sobel(torch.where(valid, x, 0.0)) for x in (pred, target))
    steep = (steep + _FLAT).sqrt()
    predicted = torch.sigmoid((steep / threshold - 1) / _SOFTNESS)
    edges = whole & (true > threshold**2)
    dims = (1, 2, 3)
    count = masked_sum(torch.ones_like(steep), edges, dim=dims)
    f1 = 2 * masked_sum(predicted, edges, dim=dims) / (masked_sum(predicted, whole, dim=dims) + count).clamp_min(1)
    return torch.where(count > 0, 1 - f1, 0.0).sum() / (count > 0).sum().clamp_min(1)


class EdgeOverlap(SingleTermLoss):
    """:func:`edge_overlap_loss` as a module. ConfigError for a threshold that is not positive."""

    name = "edges"

    def __init__(self, *, threshold: float = 0.1) -> None:
        super().__init__()
        self.threshold = convert("loss.threshold", threshold, Positive, default=0.1)

    def value(self, pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return :func:`edge_overlap_loss`."""
        return edge_overlap_loss(pred, target, valid, threshold=self.threshold)
