"""The interface of image encoders; networks, optimisers and callbacks use nothing else of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Float
from torch import Tensor, nn

from hudepth.models.options import choose


class Stage(NamedTuple):
    """A stage of an encoder, which returns one feature map."""

    name: str
    channels: int
    stride: int
    """Pixels of the image per position of the map, along each side."""
    modules: tuple[str, ...]
    """The attributes of the encoder that hold the stage's layers."""


def run_stage(module: nn.Module, *inputs: Tensor) -> Any:
    """Return ``module(*inputs)``."""
    return module(*inputs)


def draw_kernels(net: nn.Module) -> None:
    """Draw the kernels of all convolutions from He et al.'s normal distribution (2015), over outputs."""
    for module in net.modules():
        # On the meta device nothing would be drawn, but a second's worth of torch be imported.
        if isinstance(module, nn.Conv2d) and not module.weight.is_meta:
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")


NORMS = {"trained": False, "frozen": True}
"""Values of ``model.encoder_norm``: whether batch norm keeps its initial statistics."""


class Encoder(nn.Module, ABC):
    """From a normalised image to one feature map per stage.

    ``norm``: batch norm is ``trained``, or ``frozen``: it normalises with the initial statistics, in training too;
    scale and shift are trained either way. Raises ConfigError for another.
    """

    stages: tuple[Stage, ...]
    """Finest first."""

    def __init__(self, *, norm: str = "trained") -> None:
        super().__init__()
        self.norm_frozen = choose("model.encoder_norm", norm, NORMS)

    @classmethod
    @abstractmethod
    def from_pretrained(cls, weights: str | None, **options: Any) -> Encoder:
        """Build an encoder and load weights: a name or path that it knows, or None or ``none`` for random values.

        Raises CheckpointError if the weights are missing or do not fit.
        """

    @abstractmethod
    def forward(self, image: Float[Tensor, "b 3 h w"], *, run: Callable[..., Any] = run_stage) -> list[Tensor]:
        """Return the feature map of each stage, finest first, of images normalised with ImageNet's statistics.

        ``run`` runs a stage, for example :func:`hudepth.models.recompute.recomputed`.
        """

    def train(self, mode: bool = True) -> Encoder:
        """Switch to training mode, but for batch norm if that is frozen."""
        super().train(mode)
        for module in self.modules():
            if self.norm_frozen and isinstance(module, nn.BatchNorm2d):
                module.eval()
        return self

    def freeze(self, stages: int, *, frozen: bool = True) -> None:
        """Stop training the first stages, or train them again."""
        for name in (name for stage in self.stages[:stages] for name in stage.modules):
            getattr(self, name).requires_grad_(requires_grad=not frozen)


def find_encoder(net: nn.Module) -> Encoder | None:
    """Return the encoder within a network, None if it has none."""
    return next((module for module in net.modules() if isinstance(module, Encoder)), None)
