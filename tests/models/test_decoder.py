from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn import functional

from hudepth.models.decoder import Head, UpBlock, split_kernel


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


# --- linear steps that follow each other, as one ------------------------------------------------------------------


def assert_same(plain: Callable[[], Tensor], merged: Callable[[], Tensor], leaves: Iterable[Tensor]) -> None:
    """Compare results and the gradients of all leaves, in float64."""
    leaves = list(leaves)
    results = [plain(), merged()]
    torch.testing.assert_close(results[1], results[0], rtol=1e-10, atol=1e-12)
    weights = torch.randn_like(results[0])  # so that no two pixels stand for each other
    gradients = [torch.autograd.grad((result * weights).sum(), leaves) for result in results]
    for ours, theirs in zip(gradients[1], gradients[0], strict=True):
        assert theirs.abs().sum() > 0
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-11)


def leaf(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, requires_grad=True)


channels = st.integers(1, 4)
sides = st.integers(1, 5)


@given(coarse=channels, fine=channels, out=channels, height=sides, width=sides, seed=st.integers(0, 1000))
def test_a_split_kernel_does_what_the_whole_does_to_the_doubled_map(
    coarse: int, fine: int, out: int, height: int, width: int, seed: int
) -> None:
    torch.manual_seed(seed)
    x, skip = leaf(2, coarse, height, width), leaf(2, fine, 2 * height, 2 * width)
    weight, bias = leaf(out, coarse + fine, 3, 3), leaf(out)

    def plain() -> Tensor:
        doubled = x.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
        return functional.conv2d(torch.cat([doubled, skip], dim=1), weight, bias, padding=1)

    def merged() -> Tensor:
        large, small = split_kernel(weight, channels_in=coarse)
        assert large.shape == (coarse, out, 4, 4)
        assert small.equal(weight[:, coarse:])
        result = functional.conv_transpose2d(x, large, bias, stride=2, padding=1)
        return result + functional.conv2d(skip, small, padding=1)

    assert_same(plain, merged, [x, skip, weight, bias])


def test_a_split_kernel_by_hand() -> None:
    """Along one line, taps a, b, c see pixels 0 0 1 1 of the doubled line: c, b + c, a + b, a of the two."""
    weight = torch.zeros(1, 2, 3, 3)
    weight[0, 0, 1] = torch.tensor([1.0, 10.0, 100.0])
    line = torch.tensor([100.0, 110.0, 11.0, 1.0])
    expected = np.outer([0, 1, 1, 0], line)  # the middle row of taps sees each doubled row once
    np.testing.assert_array_equal(split_kernel(weight, channels_in=1)[0][0, 0], expected)


@pytest.mark.parametrize("training", [True, False])
@given(coarse=channels, fine=channels, out=channels, height=sides, width=sides, seed=st.integers(0, 1000))
def test_an_up_block_of_merged_arithmetic_is_the_same_block(
    training: bool, coarse: int, fine: int, out: int, height: int, width: int, seed: int
) -> None:
    torch.manual_seed(seed)
    blocks = [UpBlock(coarse, fine, out, arithmetic=how).double().train(training) for how in ("plain", "merged")]
    assert [block.merged for block in blocks] == [False, True]
    for bn in (blocks[0].bn1, blocks[0].bn2):
        nn.init.normal_(bn.weight)
        nn.init.normal_(bn.bias, mean=1.0)  # so that ReLU lets most of it through
    blocks[1].load_state_dict(blocks[0].state_dict())
    x, skip = leaf(2, coarse, height, width), leaf(2, fine, 2 * height, 2 * width)
    results = [block(x, skip) for block in blocks]
    torch.testing.assert_close(results[1], results[0], rtol=1e-8, atol=1e-10)
    weights = torch.randn_like(results[0])
    gradients = []
    for block, result in zip(blocks, results, strict=True):
        gradients.append(torch.autograd.grad((result * weights).sum(), [x, skip, *block.parameters()]))
    for ours, theirs in zip(gradients[1], gradients[0], strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-8)
    for ours, theirs in zip(blocks[1].buffers(), blocks[0].buffers(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)


def test_bilinear_up_blocks_stay_plain() -> None:
    torch.manual_seed(0)
    merged, plain = (UpBlock(2, 2, 2, upsample="bilinear", arithmetic=how) for how in ("merged", "plain"))
    assert not merged.merged
    plain.load_state_dict(merged.state_dict())
    x, skip = torch.randn(1, 2, 3, 3), torch.randn(1, 2, 6, 6)
    assert merged(x, skip).equal(plain(x, skip))


@given(inner=channels, middle=channels, height=sides, width=sides, seed=st.integers(0, 1000))
def test_a_joint_head_is_both_its_steps(inner: int, middle: int, height: int, width: int, seed: int) -> None:
    torch.manual_seed(seed)
    head = Head(inner, width=middle, arithmetic="merged").double()
    assert [part.shape for part in head.joint()] == [(4, inner, 3, 3), (4,)]
    x = leaf(2, inner, height, width)
    assert_same(lambda: head.steps(x), lambda: head(x), [x, *head.parameters()])


@given(inner=channels, middle=channels, height=st.integers(2, 5), width=st.integers(2, 5), seed=st.integers(0, 1000))
def test_the_joint_convolution_alone_is_right_inside(
    inner: int, middle: int, height: int, width: int, seed: int
) -> None:
    """And wrong on the outermost pixels, which is why the border takes the two steps."""
    torch.manual_seed(seed)
    head = Head(inner, width=middle).double()
    x = leaf(2, inner, height, width)
    joint = head.joint()
    inside = functional.pixel_shuffle(functional.conv2d(x, *joint, padding=1), 2)
    expected = head(x)
    torch.testing.assert_close(inside[..., 1:-1, 1:-1], expected[..., 1:-1, 1:-1], rtol=1e-10, atol=1e-12)
    assert (inside - expected)[..., 0, :].abs().max() > 1e-9


def test_a_head_of_several_channels_stays_plain() -> None:
    assert Head(4, arithmetic="merged").merged
    assert not Head(4, 64, arithmetic="merged").merged
