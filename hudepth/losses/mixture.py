"""A weighted sum of other losses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.base.types import DepthMap, LossTerms, Mask
from hudepth.losses.base import check_weights


class Mixture(nn.Module):
    """Several losses by name, each with a weight; the terms of all are logged, a loss of weight 0 is not computed.

    Raises ConfigError if the names differ, a weight is negative or not finite, or all are 0.
    """

    def __init__(self, *, losses: Mapping[str, nn.Module], weights: Mapping[str, float]) -> None:
        super().__init__()
        for name in weights:
            if name not in losses:
                raise ConfigError(f"loss.weights.{name}: no loss has this name; there are {', '.join(losses)}.")
        for name in losses:
            if name not in weights:
                raise ConfigError(f"loss.weights: none for '{name}'. Pass loss.weights.{name}=1, or 0 to leave it out.")
        check_weights("loss.weights", weights)
        self.weights = {name: float(weight) for name, weight in weights.items() if weight}
        self.losses = nn.ModuleDict({name: losses[name] for name in self.weights})

    def forward(self, pred: DepthMap, target: DepthMap, image: Float[Tensor, "b 3 h w"], valid: Mask) -> LossTerms:
        """Return the weighted sum of the losses' totals, and all their terms; arguments as in :class:`Loss`."""
        parts = {name: loss(pred, target, image, valid) for name, loss in self.losses.items()}
        total = torch.stack([self.weights[name] * part.total for name, part in parts.items()]).sum()
        # a term name that two losses share gets the loss's name in front
        names = Counter(term for part in parts.values() for term in part.terms)
        terms = {
            term if names[term] == 1 else f"{name}_{term}": value
            for name, part in parts.items()
            for term, value in part.terms.items()
        }
        return LossTerms(total, terms)
