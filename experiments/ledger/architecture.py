"""The network next to table A1, and next to what section 3.1 says instead."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from experiments.ledger.tables import SIDE_PX, TABLE_A1, ModelRow
from hudepth.models.attention import TransformerBlock
from hudepth.models.cost import parameters
from hudepth.models.hybrid_unet import HybridUNet
from hudepth.models.resnet import BasicBlock, ResNet18Encoder

Shape = tuple[int, ...]


@dataclass(frozen=True)
class Comparison:
    """A row of table A1 next to the module that corresponds to it."""

    row: ModelRow
    shapes: list[Shape]
    """What the module returned; several for the encoder, of which table A1 prints one."""
    parameters: int

    @property
    def matches(self) -> bool:
        """Whether output shape and, where the table prints it, number of parameters agree."""
        return self.row.shape in self.shapes and self.row.parameters in (None, self.parameters)


def meta_network() -> HybridUNet:
    """Return the paper's network without values: shapes and costs need none, and cost no memory."""
    with torch.device("meta"):
        return HybridUNet()


@contextmanager
def recorded_shapes(network: nn.Module) -> Iterator[dict[str, list[Shape]]]:
    """Collect what each module returns, by its dotted name, while the block runs."""
    shapes: dict[str, list[Shape]] = {}

    def recorder(name: str) -> Any:
        def record(_module: nn.Module, _inputs: Any, output: Any) -> None:
            outputs = [output] if isinstance(output, Tensor) else list(output)
            shapes[name] = [tuple(value.shape) for value in outputs if value is not None]

        return record

    handles = [module.register_forward_hook(recorder(name)) for name, module in network.named_modules()]
    try:
        yield shapes
    finally:
        for handle in handles:
            handle.remove()


def compare_with_table_a1(network: nn.Module, *, table: Sequence[ModelRow] = TABLE_A1) -> list[Comparison]:
    """Run the network on the table's batch and compare every row.

    Args:
        network: on any device; a meta network will do.
        table: rows whose modules the network has.
    """
    device = next(network.parameters()).device
    with recorded_shapes(network) as shapes, torch.enable_grad():  # without gradients eval mode would skip modules
        network(torch.empty(table[0].shape[0], 3, SIDE_PX, SIDE_PX, device=device))
    return [Comparison(row, shapes[row.module], parameters(network.get_submodule(row.module))) for row in table]


def variants_of_text() -> dict[str, int]:
    """Return the parameters of what section 3.1 describes, where it departs from table A1.

    ``encoder to 7 x 7``: ResNet-18 with layer4. ``four transformer layers on it``: blocks of 512 channels. Neither has
    a decoder yet. ``four layers on 14 x 14``: table A1's network with all four blocks on its deepest map instead.
    """
    with torch.device("meta"):
        layer4 = nn.Sequential(BasicBlock(256, 512, stride=2), BasicBlock(512, 512))
        encoder = parameters(ResNet18Encoder()) + parameters(layer4)
        without_attention = parameters(HybridUNet(attention="none"))
        return {
            "encoder to 7 x 7": encoder,
            "four transformer layers on it": 4 * parameters(TransformerBlock(512)),
            "four layers on 14 x 14": without_attention + 4 * parameters(TransformerBlock(256)),
        }
