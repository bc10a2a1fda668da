"""What a network costs: its parameters and floating-point operations."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode


def counted_flops(network: nn.Module, image: Tensor) -> int:
    """Return the FLOPs of one forward pass as PyTorch's own counter sees them.

    The network's parameters must require gradients: two fused paths of attention escape the counter, that of
    ``nn.MultiheadAttention`` without gradients, that of ``scaled_dot_product_attention`` with any backend but the plain
    one. On the meta device nothing is computed.
    """
    with torch.enable_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        network(image)
    return int(counter.get_total_flops())


def image_flops(network: nn.Module, size: tuple[int, int]) -> int:
    """Return the FLOPs of one image of (height, width) by :func:`counted_flops`, on the meta device."""
    weightless = copy.deepcopy(network).to("meta").requires_grad_(requires_grad=True)
    return counted_flops(weightless, torch.empty(1, 3, *size, device="meta"))


def parameters(module: nn.Module, *, trainable_only: bool = True) -> int:
    """Return the number of values in a module that training changes, or of all its parameters."""
    return sum(value.numel() for value in module.parameters() if value.requires_grad or not trainable_only)
