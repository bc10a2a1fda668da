"""How well a map of uncertainty tells where a prediction is wrong.

Pixels are taken away, the most uncertain ones first, and the mean error of the rest is watched. With e(f) the mean
relative error of what is left without the fraction f, and o(f) the same in order of the errors themselves::

    ause = mean over f of (e(f) - o(f)) / e(0),  f = 0, 0.01, ... 0.99

is the area under the sparsification error of Ilg et al. (Uncertainty estimates and multi-hypotheses networks for
optical flow, ECCV 2018): 0 if the order is that of the errors. The rank correlation is Spearman's, of uncertainty and
relative error: 1 if the order is the same, 0 if it says nothing.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hudepth.base.masked import widen

UNCERTAINTY_NAMES = ("flip_ause", "flip_rank_corr")
"""Of the disagreement with the prediction of the mirrored image."""
STEPS = 100


def uncertainty_metrics(
    pred_m: Float[Tensor, "b 1 h w"],
    truth_m: Float[Tensor, "b 1 h w"],
    valid: Bool[Tensor, "b 1 h w"],
    uncertainty_m: Float[Tensor, "b 1 h w"],
) -> Float[Tensor, "b 2"]:
    """Return both metrics of each image: of relative errors, and uncertainties [m] as shares of the prediction.

    NaN without a valid pixel, and where all errors or uncertainties are equal.
    """
    rows = []
    for pred, truth, counts, unsure in zip(pred_m, truth_m, valid, uncertainty_m, strict=True):
        error = widen((pred[counts] - truth[counts]).abs() / truth[counts])
        share = widen(unsure[counts] / pred[counts].clamp(min=1e-6))
        rows.append(torch.stack([ause(error, share), rank_correlation(error, share)]))
    return torch.stack(rows)


def ause(error: Float[Tensor, " n"], uncertainty: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """Return the area under the sparsification error; NaN if there is no pixel or no error."""
    if not len(error):
        return error.new_tensor(torch.nan)
    return (_sparsification(error, uncertainty) - _sparsification(error, error)).mean() / error.mean()


def _sparsification(error: Float[Tensor, " n"], order: Float[Tensor, " n"]) -> Float[Tensor, " steps"]:
    """Return the mean error of what is left when the pixels of the largest ``order`` are taken away step by step."""
    left = torch.arange(STEPS, 0, -1, device=error.device)
    count = (left * len(error) + STEPS - 1) // STEPS  # at least one pixel is left
    return error[order.argsort(stable=True)].cumsum(0)[count - 1] / count


def rank_correlation(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """Return Spearman's correlation, equal values having the mean of their ranks; NaN if either is constant."""
    if not len(a):
        return a.new_tensor(torch.nan)
    ranks = torch.stack([_ranks(a), _ranks(b)]).to(a.dtype)
    ranks = ranks - ranks.mean(dim=1, keepdim=True)
    return (ranks[0] * ranks[1]).sum() / (ranks[0].square().sum() * ranks[1].square().sum()).sqrt()


def _ranks(values: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    _, group, counts = torch.unique(values, return_inverse=True, return_counts=True)
    mean_rank: Tensor = counts.cumsum(0) - (counts - 1) / 2
    return mean_rank[group]
