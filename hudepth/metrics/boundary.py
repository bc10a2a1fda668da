"""How well depth edges are predicted: three published measures, per image.

- ``edge_*``: Hu et al. 2019 ("Revisiting Single Image Depth Estimation", WACV): pixels of steep depth, at three
  thresholds.
- ``si_boundary_f1``: Bochkovskii et al. 2024 ("Depth Pro", arXiv 2410.02073, section 3.2): which of two neighbours is
  nearer, by depth ratio; independent of the prediction's scale.
- ``dbe_*_px``: Koch et al. 2018 (iBims-1, arXiv 1805.01328): distance between predicted and true edges.

A measure is NaN if the ground truth has no edge, and 0 (the largest, for a distance) if only the prediction has none.
So the ground truth alone decides which images count. All measures depend on the resolution of the image and of depth
itself: coarsely quantised ground truth has steps where the scene has none.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from hudepth.base.masked import full_precision, widen, widest_float
from hudepth.base.sobel import squared_sobel, whole_neighbourhoods
from hudepth.base.types import DepthMap, Mask
from hudepth.metrics.canny import canny_edges, chamfer_px
from hudepth.metrics.depth import MIN_DEPTH_M

EDGE_THRESHOLDS = (0.25, 0.5, 1)
"""Sobel magnitudes [m] of Hu et al. above which a pixel is an edge."""

BOUNDARY_NAMES = (
    *(f"edge_{score}_{threshold}" for threshold in EDGE_THRESHOLDS for score in ("precision", "recall", "f1")),
    "si_boundary_f1", "dbe_acc_px", "dbe_comp_px",
)  # fmt: skip
"""Keys of :func:`boundary_metrics`."""


def boundary_metrics(pred_m: DepthMap, target_m: DepthMap, valid: Mask) -> dict[str, Float[Tensor, " b"]]:
    """All measures of this file with their published settings, by the names and in the order of :data:`BOUNDARY_NAMES`.

    ``pred_m`` [m] is finite where valid, ``target_m`` [m] positive. NaN where the ground truth has no such edge.
    """
    slopes = _squared_slopes(pred_m, target_m, valid)
    values: dict[str, Tensor] = {}
    for threshold in EDGE_THRESHOLDS:
        scores = _edge_scores(*slopes, threshold)
        values |= {f"edge_{name}_{threshold}": score for name, score in scores.items()}
    values["si_boundary_f1"] = si_boundary_f1(pred_m, target_m, valid)
    distances = depth_boundary_errors(pred_m, target_m, valid)
    return values | {f"dbe_{name}": distance for name, distance in distances.items()}


def edge_scores(
    pred_m: DepthMap, target_m: DepthMap, valid: Mask, *, threshold: float
) -> dict[str, Float[Tensor, " b"]]:
    """Precision, recall and F1 = 2 hits / (predicted + true) of predicted edge pixels, in [0, 1] (Hu et al. 2019).

    An edge pixel is one where sqrt(fx^2 + fy^2) > threshold [m], fx and fy the plain 3 x 3 Sobel sums of depth in
    metres (weights 1 2 1, not divided by 8): a step of s metres along an axis gives 4 s, so the thresholds 0.25, 0.5
    and 1 find steps above 6, 12.5 and 25 cm. Only pixels whose whole 3 x 3 window lies in the image and is valid count;
    the authors' code pads with zeros, which makes the image's border an edge in both maps.
    """
    return _edge_scores(*_squared_slopes(pred_m, target_m, valid), threshold)


def si_boundary_f1(
    pred_m: DepthMap,
    target_m: DepthMap,
    valid: Mask,
    *,
    min_ratio: float = 1.05,
    max_ratio: float = 1.25,
    steps: int = 10,
) -> Float[Tensor, " b"]:
    """Scale-invariant boundary F1 (Bochkovskii et al. 2024, section 3.2).

    A pixel occludes its left, right, upper or lower neighbour at threshold t if that is more than t times as deep. At
    each t, precision and recall of the occlusions of each direction are averaged over the directions, F1 is their
    harmonic mean (0 if both are 0), and the result is the mean of F1 over ``steps`` evenly spaced t, weighted with t.
    Pairs with an invalid pixel do not count; a prediction below :data:`~hudepth.metrics.depth.MIN_DEPTH_M` counts as
    that.

    The authors' code scores 0 for a direction or threshold without any occlusion, so that even the ground truth can
    score below 1. Here a direction counts for recall if the ground truth has occlusions, for precision if either has,
    and a threshold counts if the ground truth has. With all directions at all thresholds both agree.
    """
    ratios = torch.linspace(min_ratio, max_ratio, steps, dtype=widest_float(pred_m.device), device=pred_m.device)
    pred, target = (torch.where(valid, full_precision(x).clamp_min(MIN_DEPTH_M), 1.0) for x in (pred_m, target_m))
    counts = [_occlusions(pred, target, valid, ratios, dim=dim) for dim in (-1, -2)]
    hits, predicted, true = widen(torch.cat(counts, dim=2))  # each [b, 4 directions, steps]
    recall = _mean_where(true > 0, hits / true, dim=1)
    precision = _mean_where(true + predicted > 0, hits / predicted.clamp_min(1), dim=1)
    f1 = (2 * precision * recall / (precision + recall)).nan_to_num()
    weights: Tensor = ratios * (true.sum(dim=1) > 0)
    return (weights * f1).sum(dim=1) / weights.sum(dim=1)


def depth_boundary_errors(
    pred_m: DepthMap,
    target_m: DepthMap,
    valid: Mask,
    *,
    sigma_px: float = 2**0.5,
    low: float = 0.15,
    high: float = 0.3,
    reach_px: float = 10.0,
) -> dict[str, Float[Tensor, " b"]]:
    """Depth boundary errors (Koch et al. 2018), from exact Euclidean distances between edge pixels.

    acc_px: mean distance from a predicted edge pixel to the nearest true one, over those nearer than ``reach_px``;
        ``reach_px`` if there is none, the benchmark's penalty.
    comp_px: mean, over predicted and true edge pixels together, of the distance to the nearest of the other kind, at
        most ``reach_px``; so ``reach_px`` if nothing is predicted.

    Edges are those of Canny's detector with the benchmark's settings: depth scaled to [0, 1] by its own least and
    largest valid value, a Gaussian of ``sigma_px``, thresholds on the plain 3 x 3 Sobel magnitude. The benchmark
    compares with annotated occlusions; here the same detector finds the true edges in the ground truth.

    Invalid pixels have no weight in the Gaussian, and no gradient is taken across them. Edges within 2 pixels of one
    are dropped: they may be ends of the measured area.

    An edge begins above the Sobel magnitude ``high``, of depth in [0, 1], and is followed down to ``low``. Both
    distances are in [0, reach_px], on ``pred_m``'s device, though computed on the CPU.
    """
    rows = []
    maps = (x.detach().squeeze(1).float().cpu().numpy() for x in (pred_m, target_m))
    for pred, target, mask in zip(*maps, valid.squeeze(1).cpu().numpy(), strict=True):
        edges = (canny_edges(x, mask, sigma_px=sigma_px, low=low, high=high) for x in (pred, target))
        rows.append(chamfer_px(*edges, reach_px=reach_px))
    values = torch.tensor(rows, dtype=widest_float(pred_m.device), device=pred_m.device).reshape(-1, 2)
    return {"acc_px": values[:, 0], "comp_px": values[:, 1]}


def _squared_slopes(pred_m: Tensor, target_m: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """fx^2 + fy^2 [m^2] of both maps, without the border; 0 where a window holds an invalid pixel."""
    whole = whole_neighbourhoods(valid)
    slopes = (squared_sobel(torch.where(valid, full_precision(x), 0.0)) for x in (pred_m, target_m))
    pred, target = (torch.where(whole, slope, 0.0) for slope in slopes)
    return pred, target


def _edge_scores(pred: Tensor, target: Tensor, threshold: float) -> dict[str, Tensor]:
    """Scores from squared slopes."""
    predicted, true = pred > threshold**2, target > threshold**2
    hits, claims, edges = (widen(mask.sum(dim=(1, 2, 3))) for mask in (predicted & true, predicted, true))
    scores = {"precision": hits / claims.clamp_min(1), "recall": hits / edges, "f1": 2 * hits / (claims + edges)}
    return {name: torch.where(edges > 0, score, torch.nan) for name, score in scores.items()}


def _occlusions(
    pred: DepthMap, target: DepthMap, valid: Mask, ratios: Float[Tensor, " steps"], *, dim: int
) -> Int64[Tensor, "3 b 2 steps"]:
    """Count hits, predicted and true occlusions between neighbours along ``dim``, both ways, at each ratio."""
    size = valid.shape[dim] - 1
    pairs = [(x.narrow(dim, 0, size), x.narrow(dim, 1, size)) for x in (pred, target, valid)]
    steep = [torch.maximum(a, b) / torch.minimum(a, b) for a, b in pairs[:2]]
    # few neighbours differ by the least ratio: only those are compared
    kept = (pairs[2][0] & pairs[2][1]) & (torch.maximum(*steep) > ratios[0].item())
    at = kept.flatten().nonzero()[:, 0]
    image = at // kept[0].numel()
    (p_passed, p_way), (t_passed, t_way) = (
        (torch.bucketize(ratio.flatten()[at], ratios.to(ratio.dtype)), (a < b).flatten()[at].long())
        for ratio, (a, b) in zip(steep, pairs[:2], strict=True)
    )
    both = torch.where(p_way == t_way, torch.minimum(p_passed, t_passed), 0)
    counts = []
    for passed, way in ((both, t_way), (p_passed, p_way), (t_passed, t_way)):
        bins = (image * 2 + way) * (len(ratios) + 1) + passed  # passed: how many ratios are exceeded
        counts.append(bins.bincount(minlength=len(pred) * 2 * (len(ratios) + 1)).view(len(pred), 2, -1))
    return torch.stack(counts).flip(-1).cumsum(-1).flip(-1)[..., 1:]


def _mean_where(mask: Tensor, x: Tensor, *, dim: int) -> Tensor:
    return torch.where(mask, x, 0.0).sum(dim=dim) / mask.sum(dim=dim)
