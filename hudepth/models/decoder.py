"""The decoder of table A1: up blocks that join a coarse map with a skip, and the head.

Two pairs of its steps are linear with nothing between them: upsampling and convolution, and the head's two
convolutions. Each pair equals one smaller convolution, whose weights are sums of the original ones. ``arithmetic``
selects what is computed; the parameters are the same, and so are results and gradients up to rounding.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from hudepth.base.masked import widen
from hudepth.base.options import convert

UpsampleMode = Literal["nearest", "bilinear"]
Arithmetic = Literal["plain", "merged"]
"""``plain``: step by step, as table A1 lists them. ``merged``: consecutive linear steps as one."""


class UpBlock(nn.Module):
    """x2 upsampling, concatenation with the skip, then twice (3x3 convolution with bias, batch norm, ReLU).

    ``upsample`` is ``nearest`` (the default of figure 4's UpSampling2D) or ``bilinear``; ``arithmetic`` is ``plain`` or
    ``merged``, but bilinear upsampling is always ``plain``. Raises ConfigError for an unknown option.
    """

    def __init__(
        self,
        channels_in: int,
        channels_skip: int,
        channels_out: int,
        *,
        upsample: str = "nearest",
        arithmetic: str = "plain",
    ) -> None:
        super().__init__()
        self.upsample = convert("model.upsample", upsample, UpsampleMode, default="nearest")
        convert("model.arithmetic", arithmetic, Arithmetic, default="plain")
        self.merged = arithmetic == "merged" and upsample == "nearest"
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
        if self.merged:
            coarse, fine = split_kernel(self.conv1.weight, channels_in=self.channels_in)
            x = functional.conv_transpose2d(x, coarse, self.conv1.bias, stride=2, padding=1)
            x = x + functional.conv2d(skip, fine, padding=1)
        else:
            align = {"align_corners": False} if self.upsample == "bilinear" else {}
            x = functional.interpolate(x, scale_factor=2.0, mode=self.upsample, **align)
            x = self.conv1(torch.cat([x, skip], dim=1))
        x = self.relu(self.bn1(x))
        x = self.relu(self.bn2(self.conv2(x)))
        return x


def split_kernel(
    weight: Float[Tensor, "c_out c_both 3 3"], *, channels_in: int
) -> tuple[Float[Tensor, "c_in c_out 4 4"], Float[Tensor, "c_out c_skip 3 3"]]:
    """Split the kernel that an up block applies to (doubled coarse map, skip) so that nothing need be doubled.

    Doubled by nearest neighbour and then convolved by 3 x 3, each output pixel sees only 2 x 2 different pixels of the
    coarse map: a transposed convolution of 4 x 4 with stride 2, with 4/9 of the multiplications. The concatenation
    becomes a sum of two convolutions. The first ``channels_in`` input channels are the coarse map's.

    Returns the kernel of the transposed convolution (stride 2, padding 1) and that of the skip's (padding 1).
    """
    coarse = weight[:, :channels_in]
    for dim in (2, 3):
        a, b, c = coarse.unbind(dim)  # taps on a doubled line
        coarse = torch.stack([c, b + c, a + b, a], dim)
    return coarse.transpose(0, 1), weight[:, channels_in:]


def joint_head(
    up_weight: Float[Tensor, "c_in c_mid 4 4"],
    up_bias: Float[Tensor, " c_mid"],
    head_weight: Float[Tensor, "1 c_mid 3 3"],
    head_bias: Float[Tensor, " 1"],
) -> tuple[Float[Tensor, "4 c_in 3 3"], Float[Tensor, " 4"]]:
    """Join a transposed convolution (stride 2, padding 1) and the 3 x 3 convolution to one channel that follows it.

    Each 2 x 2 square of the result is a linear function of 3 x 3 pixels of the input: a convolution to 4 channels
    (padding 1), which :func:`torch.nn.functional.pixel_shuffle` lays out as squares. Right everywhere but on the
    outermost pixels, where the original pads what lies between the two steps. Returns its kernel and bias.
    """
    # output pixel 2 i + phase, of input pixel i + t, goes through tap m = phase + 2 - 2 t of the joint kernel
    joint = up_weight.new_zeros(len(up_weight), 6, 6)
    for row in range(3):
        for column in range(3):
            tap = torch.einsum("iokl,o->ikl", up_weight, head_weight[0, :, row, column])
            joint = joint + functional.pad(tap, (2 - column, column, 2 - row, row))
    phases = joint.reshape(-1, 3, 2, 3, 2).flip(1, 3).permute(2, 4, 0, 1, 3).flatten(0, 1)
    bias = head_bias + head_weight[0].sum((1, 2)) @ up_bias
    return phases, bias.expand(4)


class Head(nn.Module):
    """x2 upsampling to ``width`` channels by a transposed convolution, then a 3x3 convolution.

    ``arithmetic`` is ``plain`` or ``merged``; several output channels are always ``plain``.
    """

    def __init__(self, channels_in: int, channels_out: int = 1, *, width: int = 32, arithmetic: str = "plain") -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(channels_in, width, 4, stride=2, padding=1)
        self.conv = nn.Conv2d(width, channels_out, 3, padding=1)
        self.merged = arithmetic == "merged" and channels_out == 1

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c_out 2*h 2*w"]:
        """Return a map of twice the size."""
        if not self.merged:
            return self.steps(x)
        # sums of many small products, in full precision; autocast does not support the meta device
        with nullcontext() if x.is_meta else torch.autocast(x.device.type, enabled=False):
            joint = self.joint()
        return self.run_joint(x, joint)

    def steps(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c_out 2*h 2*w"]:
        """Run the two convolutions one after the other."""
        result: Tensor = self.conv(self.up(x))
        return result

    def joint(self, *, wide: bool = False) -> tuple[Float[Tensor, "4 c_in 3 3"], Float[Tensor, " 4"]]:
        """Return kernel and bias of :func:`joint_head`, in float64 if ``wide`` (float32 on MPS)."""
        assert self.up.bias is not None
        assert self.conv.bias is not None
        parts = (self.up.weight, self.up.bias, self.conv.weight, self.conv.bias)
        return joint_head(*(widen(part) if wide else part for part in parts))

    def run_joint(self, x: Float[Tensor, "b c h w"], joint: tuple[Tensor, Tensor]) -> Float[Tensor, "b 1 2*h 2*w"]:
        """Run the convolution of :func:`joint_head`, and the two steps along the border, on strips of two pixels."""
        inside = functional.pixel_shuffle(functional.conv2d(x, *joint, padding=1), 2)[:, :, 1:-1, 1:-1]
        top, bottom = self.steps(x[:, :, :2])[:, :, :1], self.steps(x[:, :, -2:])[:, :, -1:]
        left, right = self.steps(x[..., :2])[:, :, 1:-1, :1], self.steps(x[..., -2:])[:, :, 1:-1, -1:]
        return torch.cat([top, torch.cat([left, inside, right], dim=3), bottom], dim=2)
