"""What a network costs: its parameters and floating-point operations."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode


def counted_flops(network: nn.Module, image: Tensor) -> int:
    """Return the FLOPs of one forward pass as PyTorch's own counter sees them.

    Two fused paths of attention escape the counter, so both are kept out: that of ``nn.MultiheadAttention`` by leaving
    gradients on, that of ``scaled_dot_product_attention`` by its plain backend.

    Args:
        network: in any mode, with parameters that require gradients; on the meta device nothing is computed.
        image: [b, 3, h, w] on the network's device.
    """
    with torch.enable_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        network(image)
    return int(counter.get_total_flops())


def image_flops(network: nn.Module, size: tuple[int, int]) -> int:
    """Return the FLOPs of one image by :func:`counted_flops`, without computing anything.

    Args:
        network: in any form, frozen or not; it is not changed.
        size: (height, width) of the image.
    """
    weightless = copy.deepcopy(network).to("meta").requires_grad_(requires_grad=True)
    return counted_flops(weightless, torch.empty(1, 3, *size, device="meta"))


def parameters(module: nn.Module, *, trainable_only: bool = True) -> int:
    """Return the number of values in a module that training changes, or of all its parameters."""
    return sum(value.numel() for value in module.parameters() if value.requires_grad or not trainable_only)
