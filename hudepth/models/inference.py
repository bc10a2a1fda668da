"""Rewrites a trained network to compute the same in less time.

Nothing is approximated: batch norm is folded into convolutions, and consecutive linear steps become one (a convolution
of an upsampled map, the head's two layers). Results differ by rounding only, which is checked each time.
"""

from __future__ import annotations

import copy
import itertools

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from hudepth.base.console import log
from hudepth.base.machine import float32_products
from hudepth.base.masked import widen
from hudepth.models.decoder import Head, UpBlock, split_kernel
from hudepth.models.unet import UNet

TOLERANCE = 1e-5
"""Largest difference in unit depth from the original network; 0.1 mm at a maximum depth of 10 m."""


def inference_form(net: nn.Module, *, size: tuple[int, int]) -> nn.Module:
    """Return a copy of ``net`` that predicts the same in less time: in evaluation mode, frozen, channels-last.

    On two CPU cores this makes the hybrid UNet 1.3 to 1.8 times as fast (``experiments/speed``). The copy is compared
    with the original on an image of noise of (height, width); if it differs, as a custom network might, a plain copy is
    returned.
    """
    plain = copy.deepcopy(net).eval().requires_grad_(requires_grad=False)
    plain.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    fused = copy.deepcopy(plain)
    fold_batch_norm(fused)
    _merge_linear_steps(fused)
    fused.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    device = next((parameter.device for parameter in net.parameters()), torch.device("cpu"))
    image = torch.randn(1, 3, *size, generator=torch.Generator().manual_seed(0)).to(device)
    with torch.inference_mode(), float32_products(tf32=False):
        difference = float((plain(image) - fused(image)).abs().max())
    if not difference <= TOLERANCE:
        log.debug("%s: not rewritten, its output would change by %g", type(net).__name__, difference)
        return plain
    return fused


class HalfForm(nn.Module):
    """A network that computes in half precision, from and to float32; ``net`` is changed in place.

    The head and the output of a UNet stay float32: they are little work, and their roundings are the largest. With
    bfloat16, that nearly halves the mean error.
    """

    def __init__(self, net: nn.Module, dtype: torch.dtype) -> None:
        super().__init__()
        self.net, self.dtype = net, dtype
        if isinstance(net, UNet):
            for child in net.children():
                if child is not net.head and child is not net.output:
                    child.to(dtype)
            net.head.register_forward_pre_hook(lambda _, inputs: (inputs[0].float(),))
        else:
            net.to(dtype)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return unit depth."""
        unit_depth: Tensor = self.net(image.to(self.dtype)).float()
        return unit_depth


def fold_batch_norm(net: nn.Module) -> None:
    """Fold each batch norm into the convolution registered before it, in place; ``net`` must be in evaluation mode."""
    for module in net.modules():
        children = list(module.named_children())
        for (name, conv), (next_name, norm) in itertools.pairwise(children):
            if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                setattr(module, name, fuse_conv_bn_eval(conv, norm))
                setattr(module, next_name, nn.Identity())


def _merge_linear_steps(net: nn.Module) -> None:
    """Replace up blocks and heads by their merged forms, in place; batch norm must have been folded."""
    for module in list(net.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, UpBlock) and child.upsample == "nearest" and isinstance(child.bn1, nn.Identity):
                setattr(module, name, MergedUpBlock(child))
            elif isinstance(child, Head) and child.conv.out_channels == 1:
                setattr(module, name, MergedHead(child))


class MergedUpBlock(nn.Module):
    """An up block, batch norm folded, that never upsamples the coarse map (see :func:`split_kernel`)."""

    def __init__(self, block: UpBlock) -> None:
        super().__init__()
        coarse, skip = split_kernel(widen(block.conv1.weight.detach()), channels_in=block.channels_in)
        channels = block.conv1.out_channels
        self.coarse = nn.ConvTranspose2d(coarse.shape[0], channels, 4, stride=2, padding=1)
        self.skip = nn.Conv2d(skip.shape[1], channels, 3, padding=1, bias=False)
        self.conv2 = block.conv2
        self.relu = nn.ReLU(inplace=True)
        assert self.coarse.bias is not None
        assert block.conv1.bias is not None
        with torch.no_grad():
            self.coarse.weight.copy_(coarse)
            self.coarse.bias.copy_(block.conv1.bias)
            self.skip.weight.copy_(skip)
        self.requires_grad_(requires_grad=False)

    def forward(
        self, x: Float[Tensor, "b c_in h w"], skip: Float[Tensor, "b c_skip h2 w2"]
    ) -> Float[Tensor, "b c_out h2 w2"]:
        """Return a map of the skip's size."""
        x = self.relu(self.coarse(x) + self.skip(skip))
        x = self.relu(self.conv2(x))
        return x


class MergedHead(nn.Module):
    """The two convolutions of a one-channel head as one (:func:`hudepth.models.decoder.joint_head`)."""

    def __init__(self, head: Head) -> None:
        super().__init__()
        self.head = head
        self.joint = nn.Conv2d(head.up.in_channels, 4, 3, padding=1)
        assert self.joint.bias is not None
        with torch.no_grad():
            weight, bias = head.joint(wide=True)
            self.joint.weight.copy_(weight)
            self.joint.bias.copy_(bias)
        self.requires_grad_(requires_grad=False)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 2*h 2*w"]:
        """Return what the head returns."""
        assert self.joint.bias is not None
        return self.head.run_joint(x, (self.joint.weight, self.joint.bias))
