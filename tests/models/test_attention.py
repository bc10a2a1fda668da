from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from hudepth.base.errors import ConfigError
from hudepth.models.attention import TransformerBlock, sine_positions

F64 = NDArray[np.float64]


def layer_norm(x: F64, weight: F64, bias: F64) -> F64:
    mean = x.mean(-1, keepdims=True)
    variance = ((x - mean) ** 2).mean(-1, keepdims=True)
    return (x - mean) / np.sqrt(variance + 1e-5) * weight + bias


def softmax(x: F64) -> F64:
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


ACTIVATIONS = {
    "relu": lambda x: np.maximum(x, 0),
    "gelu": lambda x: x * 0.5 * (1 + np.vectorize(math.erf)(x / math.sqrt(2))),
    "silu": lambda x: x / (1 + np.exp(-x)),
}


def positions_by_hand(c: int, h: int, w: int) -> F64:
    """The encoding of each pixel, channel by channel: sines then cosines of its row, then of its column."""
    result = np.zeros((c, h, w))
    n = c // 4
    for y in range(h):
        for x in range(w):
            for i in range(n):
                angle = 10000.0 ** (-i / n)
                result[i, y, x], result[n + i, y, x] = math.sin(y * angle), math.cos(y * angle)
                result[2 * n + i, y, x], result[3 * n + i, y, x] = math.sin(x * angle), math.cos(x * angle)
    return result


def oracle(block: TransformerBlock, image: F64, *, heads: int, activation: str, positions: str = "none") -> F64:
    """Post-norm self-attention of one map [c, h, w], token by token and head by head, in numpy."""
    p = {name: value.detach().numpy() for name, value in block.named_parameters()}
    c, h, w = image.shape
    tokens = np.array([image[:, y, x] for y in range(h) for x in range(w)])
    asked = tokens
    if positions == "sine":
        where = positions_by_hand(c, h, w)
        asked = tokens + np.array([where[:, y, x] for y in range(h) for x in range(w)])
    q, k, v = (
        x @ weight.T + bias
        for x, weight, bias in zip(
            (asked, asked, tokens),
            np.split(p["attention.in_proj_weight"], 3),
            np.split(p["attention.in_proj_bias"], 3),
            strict=True,
        )
    )
    width = c // heads
    mixed = np.zeros_like(tokens)
    for head in range(heads):
        part = slice(head * width, (head + 1) * width)
        weights = softmax(q[:, part] @ k[:, part].T / math.sqrt(width))
        mixed[:, part] = weights @ v[:, part]
    attended = mixed @ p["attention.out_proj.weight"].T + p["attention.out_proj.bias"]
    x = layer_norm(tokens + attended, p["norm1.weight"], p["norm1.bias"])
    hidden = ACTIVATIONS[activation](x @ p["feed_forward.0.weight"].T + p["feed_forward.0.bias"])
    fed = hidden @ p["feed_forward.2.weight"].T + p["feed_forward.2.bias"]
    x = layer_norm(x + fed, p["norm2.weight"], p["norm2.bias"])
    result = np.zeros_like(image)
    for token, value in enumerate(x):
        result[:, token // w, token % w] = value
    return result


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("activation", ["relu", "gelu", "silu"])
@pytest.mark.parametrize("heads", [1, 4])
@pytest.mark.parametrize("positions", ["none", "sine"])
def test_block_is_post_norm_attention(positions: str, heads: int, activation: str, training: bool) -> None:
    torch.manual_seed(heads)
    block = TransformerBlock(8, heads=heads, activation=activation, positions=positions).double().train(training)
    for parameter in block.parameters():  # biases and norms start at 0 and 1, which would hide mistakes
        torch.nn.init.normal_(parameter, std=0.5)
    images = torch.randn(2, 8, 3, 5, dtype=torch.float64)
    with torch.no_grad():
        result = block(images)
    options = {"heads": heads, "activation": activation, "positions": positions}
    expected = np.stack([oracle(block, image.numpy(), **options) for image in images])
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-10, atol=1e-10)


def test_an_encoding_of_positions_has_no_parameters_and_tells_all_pixels_apart() -> None:
    plain, encoded = (TransformerBlock(8, heads=2, positions=p).state_dict() for p in ("none", "sine"))
    assert plain.keys() == encoded.keys()
    tokens = sine_positions(8, 28, 28).flatten(1).T
    distance = torch.cdist(tokens, tokens) + torch.eye(len(tokens))
    assert distance.min() > 1e-3


def test_unknown_encoding() -> None:
    with pytest.raises(ConfigError, match=r"model\.attention_positions: .*'sine'"):
        TransformerBlock(8, positions="sin")


def test_positions_are_not_encoded() -> None:
    """Shuffling the positions of the input shuffles those of the output: a block alone knows no places."""
    block = TransformerBlock(8, heads=2).eval()
    x = torch.randn(1, 8, 4, 4)
    order = torch.randperm(16)
    shuffled = x.flatten(2)[..., order].reshape(x.shape)
    torch.testing.assert_close(block(shuffled), block(x).flatten(2)[..., order].reshape(x.shape))


def test_gradient_against_finite_differences() -> None:
    torch.manual_seed(0)
    block = TransformerBlock(4, heads=2, expansion=2, activation="gelu").double()
    assert torch.autograd.gradcheck(block, torch.randn(1, 4, 2, 2, dtype=torch.float64, requires_grad=True))


def test_expansion_sets_the_width_of_the_feed_forward_layer() -> None:
    block = TransformerBlock(8, heads=2, expansion=3)
    assert [tuple(p.shape) for p in block.feed_forward.parameters()] == [(24, 8), (24,), (8, 24), (8,)]


@pytest.mark.parametrize(
    ("channels", "heads", "usable"), [(6, 4, "[1, 2]"), (5, 2, "[1]"), (16, -1, "[1, 2, 4, 8, 16]")]
)
def test_heads_that_do_not_divide(channels: int, heads: int, usable: str) -> None:
    with pytest.raises(ConfigError) as caught:
        TransformerBlock(channels, heads=heads)
    assert str(caught.value) == (
        f"model.attention_heads: {heads} heads do not divide {channels} channels. Pass one of {usable}."
    )
