"""Aligns predictions with their ground truth, image by image, before scoring.

With p the prediction and t the ground truth at the valid pixels of one image::

    median          p * median(t) / median(p)                          Zhou et al. 2017
    least_squares   s p + o,  s and o minimise sum (s p + o - t)^2     Ke et al. 2024 (Marigold)
    affine_inverse  1 / (s / p + o),  s and o minimise sum (s / p + o - 1 / t)^2    Ranftl et al. 2022 (MiDaS)
                    1 / (s d + o) for a prediction d of inverse depth

An aligned score rates the predicted shape, not its scale in metres: never compare it with an unaligned one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.base.masked import widen
from hudepth.base.types import DepthMap, Mask
from hudepth.metrics.scale import median

ALIGNMENTS = ("none", "median", "least_squares", "affine_inverse")

MAX_DEPTH_M = 1e3
"""Results of ``affine_inverse`` beyond this, or behind the camera, become this [m]."""
_MIN_DEPTH_M = 1e-3


def align(pred_m: DepthMap, target_m: DepthMap, valid: Mask, *, kind: str, inverse: bool = False) -> DepthMap:
    """Return the predictions, each aligned with its ground truth over its valid pixels.

    An image without a valid pixel is returned unchanged, as is one with a median of 0 or less. A prediction that is
    constant where valid has no scale to fit: it is shifted. A NaN or infinite prediction at a valid pixel may spread
    over its image. ``least_squares`` may return 0 m and less.

    Depths are in metres, ``target_m`` positive where valid and ignored elsewhere; ``inverse``: the predictions are
    1 / depth, up to scale and shift. Raises ConfigError if ``kind`` is not
    one of :data:`ALIGNMENTS`, or another than ``affine_inverse`` for inverse depth.
    """
    if kind not in ALIGNMENTS:
        raise ConfigError(
            f"alignment: no '{kind}'.{did_you_mean(kind, ALIGNMENTS)} Pass one of {', '.join(ALIGNMENTS)}."
        )
    if inverse and kind != "affine_inverse":
        raise ConfigError(f"alignment: '{kind}' is not for inverse depth. Pass affine_inverse.")
    if kind == "none":
        return pred_m
    one = _affine_inverted if inverse else _ONE[kind]
    images = zip(widen(pred_m), widen(target_m), valid, strict=True)
    aligned = [one(pred, pred[mask], target[mask]) if mask.any() else pred for pred, target, mask in images]
    return torch.stack(aligned).to(pred_m.dtype)


def _median(pred: Tensor, p: Tensor, t: Tensor) -> Tensor:
    middle_p = median(p)
    return pred * (median(t) / middle_p) if middle_p > 0 else pred


def _least_squares(pred: Tensor, p: Tensor, t: Tensor) -> Tensor:
    scale, shift = _line(p, t)
    return scale * pred + shift


def _affine_inverse(pred: Tensor, p: Tensor, t: Tensor) -> Tensor:
    aligned = _affine_inverted(1 / pred.clamp_min(_MIN_DEPTH_M), 1 / p.clamp_min(_MIN_DEPTH_M), t)
    # an infinite prediction has the inverse 0, which would pass for a depth
    return torch.where(pred.isfinite(), aligned, torch.nan)


def _affine_inverted(pred: Tensor, p: Tensor, t: Tensor) -> Tensor:
    scale, shift = _line(p, 1 / t)
    return 1 / (scale * pred + shift).clamp_min(1 / MAX_DEPTH_M)


def _line(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Fit y = scale x + shift; scale 1 where x is constant."""
    mean_x, mean_y = x.mean(), y.mean()
    centred = x - mean_x
    spread = centred.square().sum()
    # a spread that is rounding noise of a constant prediction has no slope to it
    scale = (centred * (y - mean_y)).sum() / spread if spread > 1e-12 * x.square().sum() else torch.ones_like(mean_x)
    return scale, mean_y - scale * mean_x


_ONE = {"median": _median, "least_squares": _least_squares, "affine_inverse": _affine_inverse}
