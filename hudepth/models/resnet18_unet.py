"""A UNet on the whole of ResNet-18: plain, or with the transformer layers that the paper's text puts at its bottom."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.models.attention import TransformerBlock
from hudepth.models.decoder import UpBlock, UpsampleMode
from hudepth.models.hybrid_unet import check_size
from hudepth.models.options import OUTPUTS, choose
from hudepth.models.resnet import ResNet18Trunk

STRIDE = 32
"""layer4's map is 1/32 of the input: 7 x 7 of the paper's 224 x 224."""


class ResNet18UNet(nn.Module):
    """One normalised RGB image in, one unit depth map of the same size out; 14,419,841 parameters without attention.

    Without attention it is the usual baseline. With four layers, 27,029,377 parameters, it is the network that section
    3.1 describes, which is not that of table A1 (:class:`hudepth.models.hybrid_unet.HybridUNet`). The text says: five
    ResNet blocks from 224 x 224 to 7 x 7, four transformer layers on the deepest features alone, four decoder blocks
    with skips from the encoder, an output layer back to 224 x 224. Where it is silent, this is as in table A1: the
    inside of transformer layers, up blocks and output layer, the skips (the four maps before the deepest one), and
    decoder blocks that are as wide as their skips: 256, 128, 64, 64.

    Args:
        weights: the trunk's start: ``imagenet``, a path, or ``none`` (see :class:`ResNet18Trunk`).
        attention_layers: transformer blocks, one after another, on layer4's output; the text says 4.
        attention_heads: heads of each block (not stated in the paper).
        attention_activation: relu, gelu or silu inside each block (not stated).
        attention_positions: ``none`` (figure 4 shows nothing) or ``sine``, added to each block's queries and keys.
        upsample: ``nearest`` (figure 4 says UpSampling2D, whose default it is) or ``bilinear``.
        output: ``sigmoid``, ``relu``, ``softplus`` or ``identity`` after the last convolution (not stated).

    Raises:
        ConfigError: for an unknown option or a negative number of layers.
        CheckpointError: if the weights cannot be had or do not fit.
    """

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
        super().__init__()
        if attention_layers < 0:
            raise ConfigError(f"model.attention_layers: {attention_layers} is less than 0. Pass 4, or 0 for none.")
        choose("model.upsample", upsample, {"nearest": 0, "bilinear": 0})
        self.trunk = ResNet18Trunk(weights=weights, layers=4)
        self.attention = nn.Sequential()
        for _ in range(attention_layers):
            self.attention.append(
                TransformerBlock(
                    512, heads=attention_heads, activation=attention_activation, positions=attention_positions
                )
            )
        self.up1 = UpBlock(512, 256, 256, upsample=upsample)
        self.up2 = UpBlock(256, 128, 128, upsample=upsample)
        self.up3 = UpBlock(128, 64, 64, upsample=upsample)
        self.up4 = UpBlock(64, 64, 64, upsample=upsample)
        self.head_up = nn.ConvTranspose2d(64, 32, 4, stride=2, padding=1)
        self.output = choose("model.output", output, OUTPUTS)()
        self.head = nn.Conv2d(32, getattr(self.output, "channels_in", 1), 3, padding=1)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Predict unit depth.

        Args:
            image: RGB, normalised with ImageNet's statistics; both sides multiples of 32.

        Returns:
            Depth / max_depth_m, in [0, 1] with the sigmoid output.

        Raises:
            ConfigError: if a side is not a multiple of 32; the message gives the nearest sizes that are.
        """
        check_size(*image.shape[-2:], stride=STRIDE)
        features = self.trunk(image)
        x = self.attention(features.layer4)
        x = self.up1(x, features.layer3)
        x = self.up2(x, features.layer2)
        x = self.up3(x, features.layer1)
        x = self.up4(x, features.stem)
        unit_depth: Tensor = self.output(self.head(self.head_up(x)))
        return unit_depth
