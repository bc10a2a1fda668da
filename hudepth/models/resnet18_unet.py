"""A UNet on all of ResNet-18: plain, or with the transformer layers that the paper's text puts at its bottom."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

from torch import Tensor, nn

from hudepth.base.options import Range, convert
from hudepth.models.attention import TransformerBlock
from hudepth.models.decoder import UpsampleMode
from hudepth.models.resnet import ResNet18Encoder
from hudepth.models.unet import UNet


class ResNet18UNet(UNet):
    """One normalised RGB image in, one unit depth map of the same size out; 14,419,841 parameters without attention.

    Both sides of an image must be multiples of 32. Without attention it is the usual baseline. With four layers,
    27,029,377 parameters, it is the network that section 3.1 describes, which is not that of table A1
    (:class:`hudepth.models.hybrid_unet.HybridUNet`). The text: five ResNet blocks from 224 x 224 to 7 x 7, four
    transformer layers on the deepest features alone, four decoder blocks with skips from the encoder, an output layer
    back to 224 x 224. What it leaves open is as in table A1: the inside of transformer layers, up blocks and output
    layer, the skips (the four maps before the deepest), and decoder blocks as wide as their skips: 256, 128, 64, 64.

    ``attention_layers``: transformer blocks, one after another, on layer4's output; the text says 4. Other options and
    errors are those of :class:`hudepth.models.hybrid_unet.HybridUNet`.
    """

    attention: nn.Module

    def __init__(
        self,
        *,
        weights: str | None = None,
        attention_layers: int = 0,
        attention_heads: int = 8,
        attention_activation: str = "relu",
        attention_positions: str = "none",
        upsample: UpsampleMode = "nearest",
        output: str = "sigmoid",
    ) -> None:
        convert("model.attention_layers", attention_layers, Annotated[int, Range(0, 64)], default=0)
        encoder = ResNet18Encoder.from_pretrained(weights, layers=4)
        block = partial(
            TransformerBlock, heads=attention_heads, activation=attention_activation, positions=attention_positions
        )
        attention = nn.Sequential(*(block(512) for _ in range(attention_layers)))
        super().__init__(encoder, attention=attention, upsample=upsample, output=output)

    def attend(self, features: list[Tensor], run: Callable[..., Any]) -> list[Tensor]:
        """Apply the transformer layers to the deepest map."""
        return [*features[:-1], run(self.attention, features[-1])]
