from __future__ import annotations

import pytest
import torch
from torch import nn

from experiments.ledger.architecture import meta_network
from experiments.ledger.cost import mult_adds_by_hand, mult_adds_by_torchinfo_rule
from hudepth.models.attention import TransformerBlock
from hudepth.models.cost import counted_flops


def test_a_convolution_is_counted() -> None:
    layer = nn.Conv2d(3, 5, 3, padding=1)
    assert counted_flops(layer, torch.zeros(2, 3, 7, 8)) == 2 * 2 * (5 * 3 * 9) * 7 * 8


def test_a_transposed_convolution_is_counted_at_its_input() -> None:
    layer = nn.ConvTranspose2d(3, 5, 4, stride=2, padding=1)
    assert counted_flops(layer, torch.zeros(1, 3, 7, 8)) == 2 * (3 * 5 * 16) * 7 * 8


@pytest.mark.parametrize("training", [True, False])
def test_attention_is_counted_in_both_modes(training: bool) -> None:
    c, n = 16, 5 * 6
    block = TransformerBlock(c, heads=4).train(training)
    assert counted_flops(block, torch.rand(1, c, 5, 6)) == 2 * (12 * c * c * n + 2 * n * n * c)


def test_pytorch_and_hand_agree_on_a_frame() -> None:
    by_hand = sum(mult_adds_by_hand().values())
    # table A1's parameters less biases and norms, times the pixels or tokens they are applied to
    encoder = 9_408 * 112**2 + 2 * (73_984 - 256) * 56**2
    encoder += (230_144 - 768 + 295_424 - 512) * 28**2 + (919_040 - 1_536 + 1_180_672 - 1_024) * 14**2
    attention = (66_048 - 512 + 131_712 - 640) * 784 + 2 * 784**2 * 128
    attention += (263_168 - 1_024 + 525_568 - 1_280) * 196 + 2 * 196**2 * 256
    decoder = (442_496 + 147_584 - 256) * 28**2 + (110_656 + 36_928 - 128) * 56**2 + (73_792 + 36_928 - 128) * 112**2
    assert by_hand == encoder + attention + decoder + (32_800 - 32) * 112**2 + (289 - 1) * 224**2
    assert counted_flops(meta_network(), torch.empty(1, 3, 224, 224, device="meta")) == 2 * by_hand


def test_hand_count_of_single_layers() -> None:
    costs = mult_adds_by_hand()
    assert costs["stem"] == 9_408 * 112 * 112
    assert costs["transposed convolution"] == (32_800 - 32) * 112 * 112
    assert costs["last convolution"] == (289 - 1) * 224 * 224
    assert costs["layer3, others"] == 3 * 256 * 256 * 9 * 14 * 14


def test_torchinfo_counts_layers_by_its_own_rule() -> None:
    network = nn.Sequential(
        nn.Conv2d(3, 4, 3, padding=1),  # 112 parameters
        nn.BatchNorm2d(4),  # 8
        nn.ReLU(),
        nn.ConvTranspose2d(4, 2, 4, stride=2, padding=1),  # 130, to 10 x 12
        nn.Linear(12, 7),  # 91
    )
    assert mult_adds_by_torchinfo_rule(network, torch.zeros(2, 3, 5, 6)) == {
        "Conv2d": 112 * 2 * 5 * 6,
        "BatchNorm2d": 8 * 2,
        "ConvTranspose2d": 130 * 2 * 10 * 12,
        "Linear": 91 * 2,
    }


def test_torchinfo_passes_over_multi_head_attention() -> None:
    costs = mult_adds_by_torchinfo_rule(TransformerBlock(8, heads=2), torch.rand(3, 8, 2, 2))
    assert costs == {"LayerNorm": 3 * 2 * 16, "Linear": 3 * ((8 * 32 + 32) + (32 * 8 + 8))}


def test_torchinfo_gives_the_papers_figure_for_its_batch() -> None:
    costs = mult_adds_by_torchinfo_rule(meta_network(), torch.empty(8, 3, 224, 224, device="meta"))
    assert f"{sum(costs.values()) / 1e9:.2f}" == "43.02"
