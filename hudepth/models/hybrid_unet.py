"""The hybrid UNet of Turkmen & Akgun (2025), table A1: ResNet-18 encoder, two transformer blocks, three up blocks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from torch import Tensor, nn

from hudepth.models.attention import PooledContext, TransformerBlock
from hudepth.models.decoder import Arithmetic, UpsampleMode
from hudepth.models.options import choose
from hudepth.models.resnet import ResNet18Encoder
from hudepth.models.unet import UNet

ATTENTION = {"none": (False, False), "skip": (True, False), "deepest": (False, True), "both": (True, True)}
"""Where the transformer blocks are: (on layer2's output, which is skip 2; on layer3's output)."""


class HybridUNet(UNet):
    """One normalised RGB image in, one unit depth map of the same size out; 4,653,313 parameters by default.

    Both sides of an image must be multiples of 16. Where table A1 and the paper's text differ, this follows table A1.
    What neither states is an option.

    Args:
        weights: of the encoder: ``imagenet``, a path, or ``none`` (see :class:`ResNet18Encoder`).
        attention: transformer blocks on ``none``, ``skip``, ``deepest`` or ``both`` (table A1).
        attention_heads, attention_activation, attention_positions: see :class:`TransformerBlock` (not stated).
        upsample, output, recompute, scale_head: see :class:`UNet`.
        arithmetic: ``plain``, or ``merged``: linear steps as one, with a fifth fewer multiplications and the same
            results up to rounding (:mod:`hudepth.models.decoder`).
        encoder_norm: batch norm of the encoder: ``trained``, or ``frozen`` to its initial statistics.
        context: the mean of the deepest map joins each of its positions (:class:`PooledContext`); not of the paper.

    Raises:
        ConfigError: for an unknown option.
        CheckpointError: if the weights are missing or do not fit.
    """

    attention_skip: nn.Module
    attention_deepest: nn.Module
    context: nn.Module

    def __init__(
        self,
        *,
        weights: str | None = None,
        attention: str = "both",
        attention_heads: int = 8,
        attention_activation: str = "relu",
        attention_positions: str = "none",
        upsample: UpsampleMode = "nearest",
        output: str = "sigmoid",
        arithmetic: Arithmetic = "plain",
        encoder_norm: str = "trained",
        recompute: bool = False,
        context: bool = False,
        scale_head: bool = False,
    ) -> None:
        on_skip, on_deepest = choose("model.attention", attention, ATTENTION)
        encoder = ResNet18Encoder.from_pretrained(weights, norm=encoder_norm)
        block = partial(
            TransformerBlock, heads=attention_heads, activation=attention_activation, positions=attention_positions
        )
        *_, skip, deepest = encoder.stages
        super().__init__(
            encoder,
            attention_skip=block(skip.channels) if on_skip else nn.Identity(),
            attention_deepest=block(deepest.channels) if on_deepest else nn.Identity(),
            context=PooledContext(deepest.channels) if context else nn.Identity(),
            upsample=upsample,
            output=output,
            arithmetic=arithmetic,
            recompute=recompute,
            scale_head=scale_head,
        )

    def attend(self, features: list[Tensor], run: Callable[..., Any]) -> list[Tensor]:
        """Apply the transformer blocks to the two deepest maps."""
        *fine, skip, deepest = features
        deepest = self.context(run(self.attention_deepest, deepest))
        return [*fine, run(self.attention_skip, skip), deepest]
