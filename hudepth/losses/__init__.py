"""Training losses; :class:`Loss` describes how they are called."""

from __future__ import annotations

from hudepth.losses.badcl import BADCL
from hudepth.losses.base import Loss, SingleTermLoss
from hudepth.losses.baselines import L1, L2, BerHu, SILog
from hudepth.losses.edges import EdgeOverlap
from hudepth.losses.gradients import GradientMatching
from hudepth.losses.mixture import Mixture
from hudepth.losses.scale import ImageScale

__all__ = [
    "BADCL", "L1", "L2", "BerHu", "EdgeOverlap", "GradientMatching", "ImageScale", "Loss", "Mixture", "SILog",
    "SingleTermLoss",
]  # fmt: skip
