"""What all losses share: how they are called, what they return, and checks of their weights."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.base.masked import full_precision
from hudepth.base.options import Range, convert
from hudepth.base.types import DepthMap, LossTerms, Mask

Positive = Annotated[float, Range(0, above=True)]


class Loss(nn.Module, ABC):
    """A training loss. Subclasses implement :meth:`terms`; those that combine other losses override ``forward``.

    To add one, write a subclass and a ``conf/loss/<name>.yaml`` with its ``_target_``.
    """

    weights: Mapping[str, float] = {}
    """Of each term; 1 if not listed."""
    __call__: Callable[..., LossTerms]  # which torch declares to return anything

    def forward(self, pred: DepthMap, target: DepthMap, image: Float[Tensor, "b 3 h w"], valid: Mask) -> LossTerms:
        """Return the weighted sum and each raw term, in float32 (float64 for float64) even under autocast.

        ``pred`` and ``target`` are unit depth in [0, 1]; ``target`` is ignored where not ``valid``, that is not
        measured. ``image`` is RGB, ImageNet-normalised; no gradient reaches it.
        """
        with torch.autocast(pred.device.type, enabled=False):
            terms = self.terms(full_precision(pred), full_precision(target), full_precision(image.detach()), valid)
            weighted = [self.weights.get(name, 1.0) * term for name, term in terms.items()]
            total = weighted[0] if len(weighted) == 1 else torch.stack(weighted).sum()
        return LossTerms(total, terms)

    @abstractmethod
    def terms(self, pred: Tensor, target: Tensor, image: Tensor, valid: Tensor) -> dict[str, Tensor]:
        """Return each term by name, from full-precision inputs."""


class SingleTermLoss(Loss):
    """A loss of one term that does not look at the image."""

    name: ClassVar[str]

    def terms(self, pred: Tensor, target: Tensor, image: Tensor, valid: Tensor) -> dict[str, Tensor]:
        """Return the term by name."""
        return {self.name: self.value(pred, target, valid)}

    @abstractmethod
    def value(self, pred: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return the loss of full-precision inputs."""


def check_weights(key: str, weights: Mapping[str, float]) -> None:
    """Raise :class:`ConfigError` if a weight of a sum is negative or not finite, or all are 0."""
    for name, weight in weights.items():
        convert(f"{key}.{name}", weight, Annotated[float, Range(0)])
    if not any(weights.values()):
        raise ConfigError(f"{key}: {', '.join(weights)} all have weight 0. Give at least one a positive weight.")


def difference(pred: DepthMap, target: DepthMap, valid: Mask) -> DepthMap:
    """Return pred - target, 0 where not valid; masked first, so that no invalid NaN enters further arithmetic."""
    return torch.where(valid, pred - target, 0.0)
