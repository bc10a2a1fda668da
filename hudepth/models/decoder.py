"""The decoder of table A1: up blocks that join a coarse map with a skip, and the head that ends in unit depth."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

UpsampleMode = Literal["nearest", "bilinear"]


class UpBlock(nn.Module):
    """x2 upsampling, concatenation with the skip, then twice (3x3 convolution with bias, batch norm, ReLU).

    Args:
        channels_in: of the coarse map.
        channels_skip: of the skip, which has twice the coarse map's size.
        channels_out: of the result.
        upsample: ``nearest`` (what figure 4's UpSampling2D does by default) or ``bilinear``.
    """

    def __init__(
        self, channels_in: int, channels_skip: int, channels_out: int, *, upsample: UpsampleMode = "nearest"
    ) -> None:
        super().__init__()
        self.upsample = upsample
        self.channels_in = channels_in
        self.conv1 = nn.Conv2d(channels_in + channels_skip, channels_out, 3, padding=1)
        self.bn1 = nn.BatchNorm2d(channels_out)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        self.bn2 = nn.BatchNorm2d(channels_out)
        self.relu = nn.ReLU(inplace=True)

    def forward(
        self, x: Float[Tensor, "b c_in h w"], skip: Float[Tensor, "b c_skip h2 w2"]
    ) -> Float[Tensor, "b c_out h2 w2"]:
        """Return a map of the skip's size."""
        align = {"align_corners": False} if self.upsample == "bilinear" else {}
        x = functional.interpolate(x, scale_factor=2.0, mode=self.upsample, **align)
        x = torch.cat([x, skip], dim=1)
        x = self.relu(self.bn1(self.conv1(x)))
        x = self.relu(self.bn2(self.conv2(x)))
        return x
