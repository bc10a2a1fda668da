"""What a frame costs, counted in three ways: by PyTorch, by hand, and by torchinfo's rule.

A multiply-add is one multiplication and one addition: two floating-point operations (FLOPs).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn


class Convolution(NamedTuple):
    """One kind of convolution of table A1 and where it is applied."""

    name: str
    channels_in: int
    channels_out: int
    kernel: int
    side: int
    """Of the map its kernel is applied to: the output, and for a transposed convolution the input."""
    times: int = 1


CONVOLUTIONS = (
    Convolution("stem", 3, 64, 7, 112),
    Convolution("layer1", 64, 64, 3, 56, times=4),
    Convolution("layer2, first", 64, 128, 3, 28),
    Convolution("layer2, shortcut", 64, 128, 1, 28),
    Convolution("layer2, others", 128, 128, 3, 28, times=3),
    Convolution("layer3, first", 128, 256, 3, 14),
    Convolution("layer3, shortcut", 128, 256, 1, 14),
    Convolution("layer3, others", 256, 256, 3, 14, times=3),
    Convolution("up block 1, first", 384, 128, 3, 28),
    Convolution("up block 1, second", 128, 128, 3, 28),
    Convolution("up block 2, first", 192, 64, 3, 56),
    Convolution("up block 2, second", 64, 64, 3, 56),
    Convolution("up block 3, first", 128, 64, 3, 112),
    Convolution("up block 3, second", 64, 64, 3, 112),
    Convolution("transposed convolution", 64, 32, 4, 112),
    Convolution("last convolution", 32, 1, 3, 224),
)
"""Written down from table A1, not read from the network."""
ATTENTION = (("transformer on layer2", 28 * 28, 128), ("transformer on layer3", 14 * 14, 256))
"""Tokens and channels of table A1's transformer blocks."""


def mult_adds_by_hand() -> dict[str, int]:
    """Return the multiply-adds of one frame by layer, from the sizes in table A1 alone.

    A convolution multiplies each of its weights once for every pixel it is applied to. A transformer block of width c
    over n tokens has weights 4 c^2 in its attention and 8 c^2 in its feed-forward layers, applied to every token, and
    two products of n x c by c x n: 12 c^2 n + 2 n^2 c. Biases, norms, pooling and activations are not counted.
    """
    costs = {c.name: c.times * c.channels_in * c.channels_out * c.kernel**2 * c.side**2 for c in CONVOLUTIONS}
    costs |= {name: 12 * c**2 * n + 2 * n**2 * c for name, n, c in ATTENTION}
    return costs


def mult_adds_by_torchinfo_rule(network: nn.Module, image: Tensor) -> dict[str, int]:
    """Return the multiply-adds of one forward pass by kind of layer, by the rule of the ``torchinfo`` package.

    Its rule: only modules without children that ran count. A convolution, transposed or not, costs its parameters
    (bias included) times batch times *output* pixels; any other module its parameters times batch, whatever number of
    tokens or pixels they are applied to. So a transposed convolution of stride 2 is counted 4 times too much, linear
    layers once instead of once per token, and ``nn.MultiheadAttention``, whose weights lie next to a child, not at all.

    Args:
        network: whose weights are called ``weight`` and ``bias``, as those of PyTorch's layers are.
        image: [b, 3, h, w] on the network's device. The result is for the whole batch.
    """
    costs: dict[str, int] = {}

    def count(module: nn.Module, _inputs: Any, output: Tensor) -> None:
        kind = type(module).__name__
        batch, pixels = output.shape[0], output.shape[2:].numel()
        applied = batch * pixels if "Conv" in kind else batch
        own = sum(value.numel() for value in module.parameters())
        costs[kind] = costs.get(kind, 0) + own * applied

    leaves = [module for module in network.modules() if not list(module.children())]
    handles = [module.register_forward_hook(count) for module in leaves]
    try:
        with torch.enable_grad():
            network(image)
    finally:
        for handle in handles:
            handle.remove()
    return {kind: cost for kind, cost in costs.items() if cost}
