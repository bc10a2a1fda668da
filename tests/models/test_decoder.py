from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.nn import functional

from hudepth.models.decoder import UpBlock


def identity_block(channels_in: int, channels_skip: int, *, keep: int, upsample: str) -> UpBlock:
    """Return a block whose convolutions hand channel ``keep`` of the concatenation through."""
    block = UpBlock(channels_in, channels_skip, 1, upsample=upsample).eval()  # type: ignore[arg-type]
    for conv in (block.conv1, block.conv2):
        nn.init.zeros_(conv.weight)
        nn.init.zeros_(conv.bias)  # type: ignore[arg-type]
    with torch.no_grad():
        block.conv1.weight[0, keep, 1, 1] = 1
        block.conv2.weight[0, 0, 1, 1] = 1
    for bn in (block.bn1, block.bn2):
        bn.eps = 0.0
    return block


def test_nearest_repeats_each_pixel() -> None:
    x, skip = torch.rand(2, 2, 3, 4), torch.rand(2, 3, 6, 8)
    result = identity_block(2, 3, keep=1, upsample="nearest")(x, skip)
    expected = x[:, 1:2].repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
    torch.testing.assert_close(result, expected)


def test_bilinear_weighs_quarters() -> None:
    x, skip = torch.rand(1, 1, 1, 4), torch.rand(1, 1, 2, 8)
    result = identity_block(1, 1, keep=0, upsample="bilinear")(x, skip)[0, 0]
    a, b, c, d = x.flatten().tolist()
    row = [a, 0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b, 0.75 * b + 0.25 * c, 0.25 * b + 0.75 * c]
    row += [0.75 * c + 0.25 * d, 0.25 * c + 0.75 * d, d]
    torch.testing.assert_close(result, torch.tensor([row, row]))


def test_the_skip_comes_after_the_coarse_map() -> None:
    x, skip = torch.rand(2, 2, 3, 4), torch.rand(2, 3, 6, 8)
    torch.testing.assert_close(identity_block(2, 3, keep=4, upsample="nearest")(x, skip), skip[:, 2:3])


@pytest.mark.parametrize("training", [True, False])
def test_up_block_is_conv_norm_relu_twice(training: bool) -> None:
    torch.manual_seed(0)
    block = UpBlock(4, 2, 3).train(training)
    for bn in (block.bn1, block.bn2):
        nn.init.normal_(bn.weight)
        nn.init.normal_(bn.bias)
    x, skip = torch.randn(2, 4, 3, 5), torch.randn(2, 2, 6, 10)
    expected = torch.cat([x.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3), skip], dim=1)
    for conv, bn in ((block.conv1, block.bn1), (block.conv2, block.bn2)):
        expected = functional.conv2d(expected, conv.weight, conv.bias, padding=1)
        if training:
            mean, var = expected.mean(dim=(0, 2, 3)), expected.var(dim=(0, 2, 3), unbiased=False)
        else:
            mean, var = torch.zeros(3), torch.ones(3)
        shape = (1, 3, 1, 1)
        expected = (expected - mean.view(shape)) / (var.view(shape) + 1e-5).sqrt()
        expected = (expected * bn.weight.view(shape) + bn.bias.view(shape)).clamp(min=0)
    torch.testing.assert_close(block(x, skip), expected, rtol=1e-4, atol=1e-5)


def test_inputs_stay_as_they_are() -> None:
    """ReLU works in place, but never on what it was handed: skips are used twice."""
    x, skip = torch.randn(1, 2, 2, 2), torch.randn(1, 2, 4, 4)
    before = x.clone(), skip.clone()
    UpBlock(2, 2, 2)(x, skip)
    assert torch.equal(x, before[0])
    assert torch.equal(skip, before[1])
