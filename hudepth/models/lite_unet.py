"""A UNet for CPUs: EfficientNet-Lite0 and a decoder of depthwise convolutions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from hudepth.base.options import Range, convert
from hudepth.models.attention import PooledContext
from hudepth.models.decoder import Arithmetic, UpsampleMode
from hudepth.models.efficientnet import EfficientNetLite0Encoder
from hudepth.models.unet import UNet

_Widths = Annotated[tuple[int, int, int, int], Range(1)]
WIDTHS = (192, 128, 64, 32)


class LiteUpBlock(nn.Module):
    """x2 upsampling and a skip, added, and a residual: 5x5 depthwise and 1x1, each with batch norm.

    Both inputs pass a 1x1 convolution first, the coarse map before it is upsampled. Raises ConfigError for an unknown
    ``upsample``.
    """

    def __init__(self, channels_in: int, channels_skip: int, channels_out: int, *, upsample: str = "nearest") -> None:
        super().__init__()
        self.upsample = convert("model.upsample", upsample, UpsampleMode, default="nearest")
        self.coarse = nn.Sequential(nn.Conv2d(channels_in, channels_out, 1, bias=False), nn.BatchNorm2d(channels_out))
        self.skip = nn.Sequential(nn.Conv2d(channels_skip, channels_out, 1, bias=False), nn.BatchNorm2d(channels_out))
        self.residual = nn.Sequential(
            nn.Conv2d(channels_out, channels_out, 5, padding=2, groups=channels_out, bias=False),
            nn.BatchNorm2d(channels_out),
            nn.ReLU(inplace=True),
            nn.Conv2d(channels_out, channels_out, 1, bias=False),
            nn.BatchNorm2d(channels_out),
        )

    def forward(
        self, x: Float[Tensor, "b c_in h w"], skip: Float[Tensor, "b c_skip h2 w2"]
    ) -> Float[Tensor, "b c_out h2 w2"]:
        """Return a map of the skip's size."""
        align = {"align_corners": False} if self.upsample == "bilinear" else {}
        x = functional.interpolate(self.coarse(x), scale_factor=2.0, mode=self.upsample, **align)
        x = functional.relu(x + self.skip(skip))
        return functional.relu(x + self.residual(x))


class LiteUNet(UNet):
    """One normalised RGB image in, one unit depth map of the same size out; 3,275,457 parameters by default.

    Both sides of an image must be multiples of 32. It is no part of the paper, whose future work is a lighter network.

    Args:
        weights: of the encoder: ``imagenet``, a path, or ``none`` (see :class:`EfficientNetLite0Encoder`).
        widths: channels of the four up blocks, from 1/16 to 1/2 of the image's size.
        context: the mean of the deepest map joins each of its positions (:class:`PooledContext`).
        upsample, output, arithmetic, recompute, scale_head: see :class:`hudepth.models.unet.UNet`; ``merged`` concerns
            the head.
        encoder_norm: batch norm of the encoder: ``trained``, or ``frozen`` to its initial statistics.

    Raises:
        ConfigError: for an unknown option.
        CheckpointError: if the weights are missing or do not fit.
    """

    context: nn.Module

    def __init__(
        self,
        *,
        weights: str | None = None,
        widths: Sequence[int] = WIDTHS,
        context: bool = True,
        upsample: UpsampleMode = "bilinear",
        output: str = "sigmoid",
        arithmetic: Arithmetic = "plain",
        encoder_norm: str = "trained",
        recompute: bool = False,
        scale_head: bool = False,
    ) -> None:
        encoder = EfficientNetLite0Encoder.from_pretrained(weights, norm=encoder_norm)
        super().__init__(
            encoder,
            upsample=upsample,
            output=output,
            arithmetic=arithmetic,
            recompute=recompute,
            scale_head=scale_head,
            widths=convert("model.widths", widths, _Widths),
            up_block=LiteUpBlock,
            context=PooledContext(encoder.stages[-1].channels) if context else nn.Identity(),
        )

    def attend(self, features: list[Tensor], run: Callable[..., Any]) -> list[Tensor]:
        """Add the context to the deepest map."""
        return [*features[:-1], run(self.context, features[-1])]
