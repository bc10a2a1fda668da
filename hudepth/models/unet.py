"""What the UNets share: an encoder, optional attention on its feature maps, and the decoder of table A1."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.models.attention import ScaleHead
from hudepth.models.decoder import Head, UpBlock
from hudepth.models.encoder import Encoder, run_stage
from hudepth.models.options import OUTPUTS, choose
from hudepth.models.recompute import recomputed


class UNet(nn.Module):
    """One normalised RGB image in, one unit depth map of the same size out.

    The decoder has an up block for each of the encoder's stages but the deepest, by default as wide as that stage.

    Args:
        encoder: at least two stages, each of half the size of the one before, the first of half the image's size.
        upsample: ``nearest`` (figure 4 says UpSampling2D, whose default it is) or ``bilinear``.
        output: from the last convolution to unit depth, one of :data:`hudepth.models.options.OUTPUTS`.
        arithmetic: ``plain`` or ``merged``; see :mod:`hudepth.models.decoder`.
        recompute: in training, recompute each stage's activations for the gradients instead of keeping them.
        scale_head: shift the map before its output by a number for the whole image (:class:`ScaleHead`).
        widths: of the up blocks, coarsest first.
        up_block: makes an up block from the channels of the coarse map, of the skip and of its result.
        **attention: further modules, by attribute name, for :meth:`attend`.

    Raises:
        ConfigError: for an unknown option.
    """

    def __init__(
        self,
        encoder: Encoder,
        *,
        upsample: str = "nearest",
        output: str = "sigmoid",
        arithmetic: str = "plain",
        recompute: bool = False,
        scale_head: bool = False,
        widths: Sequence[int] | None = None,
        up_block: Callable[..., nn.Module] | None = None,
        **attention: nn.Module,
    ) -> None:
        super().__init__()
        self.recompute = recompute
        self.encoder = encoder
        for name, module in attention.items():
            self.add_module(name, module)
        deepest, *skips = [stage.channels for stage in reversed(encoder.stages)]
        channels = [deepest, *(skips if widths is None else widths)]
        make = up_block or partial(UpBlock, arithmetic=arithmetic)
        self._up = [f"up{i}" for i in range(1, len(channels))]
        for name, (coarse, width), skip in zip(self._up, pairwise(channels), skips, strict=True):
            self.add_module(name, make(coarse, skip, width, upsample=upsample))
        final = choose("model.output", output, OUTPUTS)()
        self.head = Head(channels[-1], getattr(final, "channels_in", 1), arithmetic=arithmetic)
        self.output = final
        self.scale = ScaleHead(deepest) if scale_head else None
        if scale_head and self.head.conv.out_channels > 1:
            raise ConfigError(
                f"model.scale_head: model.output={output} has no map to shift. Pass model.output=sigmoid."
            )

    def attend(self, features: list[Tensor], run: Callable[..., Any]) -> list[Tensor]:
        """Return the encoder's feature maps, finest first, as the decoder takes them; ``run`` runs a module."""
        raise NotImplementedError

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Predict depth / max_depth_m, in [0, 1] with the sigmoid output, from ImageNet-normalised RGB.

        Raises ConfigError if a side is not a multiple of the deepest stage's stride; see :func:`check_size`.
        """
        check_size(*image.shape[-2:], stride=self.encoder.stages[-1].stride)
        run = recomputed if self.recompute and self.training else run_stage
        *skips, deepest = self.attend(self.encoder(image, run=run), run)
        x = deepest
        for name, skip in zip(self._up, reversed(skips), strict=True):
            x = run(getattr(self, name), x, skip)
        x = self.head(x) if self.scale is None else self.head(x) + self.scale(deepest)
        unit_depth: Tensor = self.output(x)
        return unit_depth


def check_size(height: int, width: int, *, stride: int) -> None:
    """Check that a network whose deepest map has one position per ``stride`` pixels takes images of this size.

    Raises ConfigError if a side is not a positive multiple of ``stride``; the message gives the nearest sizes that are.
    """
    if height < stride or width < stride or height % stride or width % stride:
        below = [max(stride, side // stride * stride) for side in (height, width)]
        above = [max(stride, -(-side // stride) * stride) for side in (height, width)]
        nearest = " or ".join(dict.fromkeys(f"[{h},{w}]" for h, w in (below, above)))
        raise ConfigError(
            f"data.size: images of {height} x {width} (height x width), but both sides must be multiples of "
            f"{stride}. Pass data.size={nearest}."
        )
