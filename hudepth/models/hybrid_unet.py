"""The hybrid UNet of Turkmen & Akgun (2025), table A1: ResNet-18 trunk, two transformer blocks, three up blocks."""

from __future__ import annotations

from contextlib import nullcontext

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.models.attention import TransformerBlock
from hudepth.models.decoder import ARITHMETIC, Arithmetic, UpBlock, UpsampleMode, is_usual_head, joint_head, run_head
from hudepth.models.options import OUTPUTS, choose
from hudepth.models.recompute import recomputed
from hudepth.models.resnet import ResNet18Trunk, run_stage

STRIDE = 16
"""The trunk's deepest map is 1/16 of the input, so both sides of an image must be multiples of it."""

ATTENTION = {"none": (False, False), "skip": (True, False), "deepest": (False, True), "both": (True, True)}
"""Where transformer blocks stand: (on layer2's output, which is skip 2; on layer3's output)."""


class HybridUNet(nn.Module):
    """One normalised RGB image in, one unit depth map of the same size out; 4,653,313 parameters by default.

    Table A1 is the authority where it differs from the paper's text. What neither states is an option.

    Args:
        weights: the trunk's start: ``imagenet``, a path, or ``none`` (see :class:`ResNet18Trunk`).
        attention: transformer blocks on ``none``, ``skip``, ``deepest`` or ``both`` (table A1).
        attention_heads: heads of each block (not stated in the paper).
        attention_activation: relu, gelu or silu inside each block (not stated).
        attention_positions: ``none`` (figure 4 shows nothing) or ``sine``, added to each block's queries and keys.
        upsample: ``nearest`` (figure 4 says UpSampling2D, whose default it is) or ``bilinear``.
        output: from the last convolution to unit depth, one of :data:`hudepth.models.options.OUTPUTS` (not stated).
        arithmetic: ``plain``, or ``merged``: linear steps as one, with a fifth fewer multiplications and the same
            results but for rounding (:mod:`hudepth.models.decoder`).
        recompute: in training, keep the activations of no stage but compute them again for the gradients: less memory
            for more time, the same results.
        trunk_norm: batch norm of the trunk: ``trained``, or ``frozen`` to the statistics it starts with.

    Raises:
        ConfigError: for an unknown option.
        CheckpointError: if the weights cannot be had or do not fit.
    """

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
        trunk_norm: str = "trained",
        recompute: bool = False,
    ) -> None:
        super().__init__()
        self.recompute = recompute
        on_skip, on_deepest = choose("model.attention", attention, ATTENTION)
        choose("model.upsample", upsample, {"nearest": 0, "bilinear": 0})
        choose("model.arithmetic", arithmetic, dict.fromkeys(ARITHMETIC, 0))

        def block(channels: int) -> nn.Module:
            return TransformerBlock(
                channels, heads=attention_heads, activation=attention_activation, positions=attention_positions
            )

        self.trunk = ResNet18Trunk(weights=weights, norm=trunk_norm)
        self.attention_skip = block(128) if on_skip else nn.Identity()
        self.attention_deepest = block(256) if on_deepest else nn.Identity()
        self.up1 = UpBlock(256, 128, 128, upsample=upsample, arithmetic=arithmetic)
        self.up2 = UpBlock(128, 64, 64, upsample=upsample, arithmetic=arithmetic)
        self.up3 = UpBlock(64, 64, 64, upsample=upsample, arithmetic=arithmetic)
        self.head_up = nn.ConvTranspose2d(64, 32, 4, stride=2, padding=1)
        self.output = choose("model.output", output, OUTPUTS)()
        self.head = nn.Conv2d(32, getattr(self.output, "channels_in", 1), 3, padding=1)
        self.merged = arithmetic == "merged" and is_usual_head(self.head_up, self.head)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Predict unit depth.

        Args:
            image: RGB, normalised with ImageNet's statistics; both sides multiples of 16.

        Returns:
            Depth / max_depth_m, in [0, 1] with the sigmoid output.

        Raises:
            ConfigError: if a side is not a multiple of 16; the message gives the nearest sizes that are.
        """
        check_size(*image.shape[-2:])
        run = recomputed if self.recompute and self.training else run_stage
        features = self.trunk(image, run=run)
        x = run(self.attention_deepest, features.layer3)
        x = run(self.up1, x, run(self.attention_skip, features.layer2))
        x = run(self.up2, x, features.layer1)
        x = run(self.up3, x, features.stem)
        unit_depth: Tensor = self.output(self._head(x))
        return unit_depth

    def _head(self, x: Tensor) -> Tensor:
        if not self.merged:
            result: Tensor = self.head(self.head_up(x))
            return result
        # sums of many small products, in full precision; autocast knows nothing of devices without numbers
        with nullcontext() if x.is_meta else torch.autocast(x.device.type, enabled=False):
            joint = joint_head(self.head_up.weight, self.head_up.bias, self.head.weight, self.head.bias)
        return run_head(self.head_up, self.head, x, joint=joint)


def check_size(height: int, width: int, *, stride: int = STRIDE) -> None:
    """Check that a network can take images of this size.

    Args:
        height: of the images [pixels].
        width: of the images [pixels].
        stride: side of the square of pixels that one position of the network's deepest map stands for.

    Raises:
        ConfigError: if a side is not a positive multiple of ``stride``; the message computes the nearest sizes.
    """
    if height < stride or width < stride or height % stride or width % stride:
        below = [max(stride, side // stride * stride) for side in (height, width)]
        above = [max(stride, -(-side // stride) * stride) for side in (height, width)]
        nearest = " or ".join(dict.fromkeys(f"[{h},{w}]" for h, w in (below, above)))
        raise ConfigError(
            f"data.size: images of {height} x {width} (height x width), but both sides must be multiples of "
            f"{stride}. Pass data.size={nearest}."
        )
