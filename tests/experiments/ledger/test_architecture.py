from __future__ import annotations

from dataclasses import replace

import torch
from torch import nn

from experiments.ledger.architecture import compare_with_table_a1, meta_network, recorded_shapes, variants_of_text
from experiments.ledger.tables import TABLE_A1
from hudepth.models.cost import parameters
from hudepth.models.hybrid_unet import HybridUNet


def test_parameters_counts_what_training_changes() -> None:
    layer = nn.Conv2d(3, 5, 2)
    assert parameters(layer) == 5 * 3 * 2 * 2 + 5
    layer.bias.requires_grad_(False)  # type: ignore[union-attr]
    assert parameters(layer) == 5 * 3 * 2 * 2


def test_shapes_are_recorded_and_hooks_removed() -> None:
    network = nn.Sequential(nn.Conv2d(3, 4, 3, stride=2), nn.Flatten())
    with recorded_shapes(network) as shapes:
        network(torch.zeros(2, 3, 9, 9))
    assert shapes == {"0": [(2, 4, 4, 4)], "1": [(2, 64)], "": [(2, 64)]}
    network(torch.zeros(1, 3, 9, 9))
    assert shapes["1"] == [(2, 64)]


def test_every_row_of_table_a1_agrees() -> None:
    compared = compare_with_table_a1(meta_network())
    assert len(compared) == len(TABLE_A1)
    assert all(c.matches for c in compared)


def test_a_row_that_differs_is_found() -> None:
    table = list(TABLE_A1)
    table[3] = replace(table[3], parameters=9_409)
    table[-1] = replace(table[-1], shape=(8, 1, 112, 112))
    wrong = [c.row.module for c in compare_with_table_a1(meta_network(), table=table) if not c.matches]
    assert wrong == ["encoder.conv1", "head.conv"]


def test_a_network_of_another_make_does_not_agree() -> None:
    with torch.device("meta"):
        network = HybridUNet(attention_heads=4)
        network.head.up = nn.ConvTranspose2d(64, 32, 2, stride=2)
    wrong = [c.row.module for c in compare_with_table_a1(network) if not c.matches]
    assert wrong == ["head.up"]


def test_variants_of_the_text_by_hand() -> None:
    block = 2 * 512 * 512 * 9 + 2 * 2 * 512  # two 3 x 3 convolutions and two batch norms
    layer4 = (256 * 512 * 9 + 512 * 512 * 9 + 256 * 512 + 3 * 2 * 512) + block

    def transformer(c: int) -> int:
        return (4 * c * c + 4 * c) + (8 * c * c + 5 * c) + 4 * c  # attention, feed-forward, two layer norms

    encoder = 9_408 + 128 + 2 * 73_984 + 230_144 + 295_424 + 919_040 + 1_180_672
    assert variants_of_text() == {
        "encoder to 7 x 7": encoder + layer4,
        "four transformer layers on it": 4 * transformer(512),
        "four layers on 14 x 14": 4_653_313 - transformer(128) + 3 * transformer(256),
    }
