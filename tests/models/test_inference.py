"""The rewritten network against the network it was made from."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn import functional

from hudepth.models import HybridUNet, ResNet18UNet, TinyUNet
from hudepth.models.decoder import Head, UpBlock
from hudepth.models.inference import TOLERANCE, HalfForm, MergedHead, MergedUpBlock, fold_batch_norm, inference_form


def lived_in(net: nn.Module, seed: int = 0) -> nn.Module:
    """Give batch norm statistics and parameters as after training: fresh ones would hide a mistake."""
    generator = torch.Generator().manual_seed(seed)
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.5, generator=generator)
            module.running_var.uniform_(0.5, 2, generator=generator)
            module.weight.data.uniform_(0.5, 1.5, generator=generator)
            module.bias.data.normal_(0, 0.2, generator=generator)
    return net.eval()


@pytest.mark.parametrize(
    ("net", "merged"),
    [
        (HybridUNet(), 4),
        (HybridUNet(attention="none", output="identity"), 4),
        (HybridUNet(upsample="bilinear", output="softplus"), 1),  # the head alone
        (ResNet18UNet(attention_layers=1), 5),
        (TinyUNet(), 0),
    ],
    ids=["hybrid", "plain", "bilinear", "resnet18", "tiny"],
)
def test_the_rewritten_network_predicts_the_same(net: nn.Module, merged: int) -> None:
    lived_in(net)
    before = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    fast = inference_form(net, size=(64, 96))
    image = torch.randn(2, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        expected = net(image)
        assert (fast(image) - expected).abs().max() <= 1e-5 * max(1, float(expected.abs().max()))
    assert sum(isinstance(module, MergedHead | MergedUpBlock) for module in fast.modules()) == merged
    assert not any(isinstance(module, nn.BatchNorm2d) for module in fast.modules())
    assert all(torch.equal(before[name], tensor) for name, tensor in net.state_dict().items())  # a copy was rewritten
    assert not any(parameter.requires_grad for parameter in fast.parameters())


@given(
    st.integers(1, 4), st.integers(1, 5), st.integers(1, 6), st.integers(1, 6), st.integers(0, 2**31 - 1),
)  # fmt: skip
def test_an_up_block_of_any_shape_is_merged_exactly(
    channels_in: int, channels_skip: int, height: int, width: int, seed: int
) -> None:
    torch.manual_seed(seed)
    block = lived_in(UpBlock(channels_in, channels_skip, 3), seed).double()
    x, skip = torch.randn(2, channels_in, height, width), torch.randn(2, channels_skip, 2 * height, 2 * width)
    expected = block(x.double(), skip.double())
    fold_batch_norm(block)
    assert isinstance(block, UpBlock)
    merged = MergedUpBlock(block.double()).double()
    # the merged weights are kept in float32, so the sums agree to that
    assert torch.allclose(merged(x.double(), skip.double()), expected, atol=1e-5, rtol=1e-5)


@given(st.integers(1, 4), st.integers(1, 4), st.integers(2, 7), st.integers(2, 7), st.integers(0, 2**31 - 1))
def test_a_head_is_merged_exactly_up_to_the_border(
    channels_in: int, channels: int, height: int, width: int, seed: int
) -> None:
    torch.manual_seed(seed)
    head = Head(channels_in, width=channels)
    x = torch.randn(1, channels_in, height, width)
    assert torch.allclose(MergedHead(head)(x), head(x), atol=1e-5)


class NormThatDoesNotFollow(nn.Module):
    """Batch norm is registered after the convolution but applied before it: folding it would be wrong."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 3, 3, padding=1)
        self.norm = nn.BatchNorm2d(3)
        self.last = nn.Conv2d(3, 1, 1)

    def forward(self, image: Tensor) -> Tensor:
        return functional.softplus(self.last(self.conv(self.norm(image))))


def test_a_network_that_cannot_be_rewritten_stays_as_it_is() -> None:
    net = lived_in(NormThatDoesNotFollow())
    same = inference_form(net, size=(16, 32))
    image = torch.randn(1, 3, 16, 32)
    assert (same(image) - net(image)).abs().max() <= TOLERANCE
    assert any(isinstance(module, nn.BatchNorm2d) for module in same.modules())


@pytest.mark.parametrize(("dtype", "most"), [(torch.bfloat16, 2**-6), (torch.float16, 2**-9)])
@pytest.mark.parametrize(
    "make",
    [HybridUNet, partial(HybridUNet, output="bins", attention_positions="sine"), TinyUNet],
    ids=["hybrid", "bins-sine", "tiny"],
)
def test_half_precision_costs_only_its_roundings(
    make: Callable[[], nn.Module], dtype: torch.dtype, most: float
) -> None:
    torch.manual_seed(0)
    net = inference_form(lived_in(make()), size=(32, 48))
    image = torch.randn(2, 3, 32, 48, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        expected = net(image)
        half = HalfForm(net, dtype)
        found = half(image)
    assert found.dtype == torch.float32
    assert 0 < (found - expected).abs().max() < most
    kinds = {name: parameter.dtype for name, parameter in half.net.named_parameters()}
    last = [name for name in kinds if name.startswith(("head", "output"))]
    assert {kinds[name] for name in kinds if name not in last} == {dtype}
    assert {kinds[name] for name in last} <= {torch.float32}
