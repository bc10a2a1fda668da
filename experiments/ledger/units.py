"""What SSIM, loss and RMSE are at the paper's relative error, when depth is read rightly and when it is not.

DenseDepth's 8-bit training depth means value / 255 * 10 m. Read as millimetres, as section 2.3 puts it (divide by 1000,
clip to 10 m, divide by 10), every value is 255 / 10,000 of what it should be, so targets fill 2.55 % of [0, 1].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from experiments.ledger.tables import LOSS_WEIGHTS, MAX_DEPTH_M, PROPOSED
from hudepth.base.normalise import normalise_image
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses.badcl import BADCL, scaling_factor, scaling_loss
from hudepth.metrics.depth import depth_metrics
from hudepth.metrics.ssim import ssim

READINGS: Mapping[str, float] = {"metres / 10": 1.0, "8 bit read as millimetres": 255 / MAX_DEPTH_M / 1000}
"""How depth is read, and the factor on unit depth that follows."""


ERRORS = ("wrong scale", "smooth error", "pixel noise")
"""Kinds of error that predictions of one abs_rel can have, from the kindest to SSIM to the harshest."""


@dataclass(frozen=True)
class Rooms:
    """Built-in rooms as the network would see them."""

    image: Float[Tensor, "b 3 h w"]
    """Normalised RGB."""
    unit_depth: Float[Tensor, "b 1 h w"]
    """Depth clipped to 10 m, / 10 m."""


@dataclass(frozen=True)
class Score:
    """A prediction's figures under one reading of the depth files."""

    reading: str
    prediction: str
    abs_rel: float
    rmse_m: float
    """In metres as the reading has them."""
    ssim: float
    """Data range 1, window 11, on unit depth."""
    loss: float
    """BADCL with the paper's weights."""


def render_rooms(*, frames: int, side_px: int) -> Rooms:
    """Render one frame of each of ``frames`` rooms, seed 0.

    Args:
        frames: how many, each of a room of its own.
        side_px: height and width.
    """
    source = RoomsSource(scenes=frames, frames_per_scene=1, size=(side_px, side_px))
    pairs = [source.read(record) for record in source.records()]
    image = torch.from_numpy(np.stack([pair.image for pair in pairs])).permute(0, 3, 1, 2) / 255
    depth = torch.from_numpy(np.stack([pair.depth for pair in pairs])).float().unsqueeze(1)
    return Rooms(normalise_image(image), (depth / MAX_DEPTH_M).clamp(max=1))


def predictions(rooms: Rooms, *, abs_rel: float = PROPOSED.abs_rel, seed: int = 0) -> dict[str, Tensor]:
    """Make predictions: the ground truth itself, three of a given relative error, and two that have seen no image.

    The three (:data:`ERRORS`) are the ground truth times 1 + e, with e one number per image (``wrong scale``, of random
    sign), a Gaussian field of about seven lumps across (``smooth error``), or drawn per pixel (``pixel noise``); e is
    scaled so that each image's abs_rel is exact. ``mean depth map`` and ``mean depth`` are those of the ground truth,
    which flatters them a little.

    Args:
        rooms: the ground truth.
        abs_rel: mean of |e|.
        seed: of e.
    """
    truth = rooms.unit_depth
    draw = torch.Generator().manual_seed(seed)
    lumps = torch.randn(len(truth), 1, 7, 7, generator=draw)
    fields = {
        "wrong scale": torch.randint(0, 2, (len(truth), 1, 1, 1), generator=draw) * 2.0 - 1,
        "smooth error": functional.interpolate(lumps, truth.shape[-2:], mode="bicubic", align_corners=True),
        "pixel noise": torch.randn(truth.shape, generator=draw),
    }
    made = {"truth itself": truth}
    for name, e in fields.items():
        made[name] = truth * (1 + e * abs_rel / e.abs().mean(dim=(1, 2, 3), keepdim=True))
    made["mean depth map"] = truth.mean(dim=0, keepdim=True).expand_as(truth)
    made["mean depth"] = truth.mean().expand_as(truth)
    return made


def score_readings(rooms: Rooms, made: Mapping[str, Tensor]) -> list[Score]:
    """Score each prediction under each of :data:`READINGS`.

    Args:
        rooms: the ground truth.
        made: predictions of unit depth [b, 1, h, w].
    """
    weights = LOSS_WEIGHTS
    loss = BADCL(boundary=weights["boundary"], smoothness=weights["smoothness"], scaling=weights["scaling"])
    valid = torch.ones_like(rooms.unit_depth, dtype=torch.bool)
    scores = []
    for reading, factor in READINGS.items():
        target = rooms.unit_depth * factor
        for name, prediction in made.items():
            pred = prediction * factor
            metrics = depth_metrics(pred * MAX_DEPTH_M, target * MAX_DEPTH_M, valid)
            scores.append(
                Score(
                    reading,
                    name,
                    abs_rel=float(metrics["abs_rel"].mean()),
                    rmse_m=float(metrics["rmse"].mean()),
                    ssim=float(ssim(pred, target, data_range=1.0).mean()),
                    loss=float(loss(pred, target, rooms.image, valid).total),
                )
            )
    return scores


def scaling_at_eps(rooms: Rooms, prediction: Tensor, *, eps: float) -> tuple[float, float]:
    """Return the mean factor s of the scaling term (equation 5) and the term itself (equation 4).

    Args:
        rooms: the ground truth.
        prediction: unit depth [b, 1, h, w].
        eps: what is added to the sum of predictions.
    """
    truth = rooms.unit_depth
    valid = torch.ones_like(truth, dtype=torch.bool)
    factor = scaling_factor(prediction, truth, valid, eps=eps).mean()
    return float(factor), float(scaling_loss(prediction, truth, valid, eps=eps))
