"""What positions of a map know of each other: the transformer block (section 3.1, figure 4), pooled context, scale."""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.base.masked import widest_float
from hudepth.base.options import convert
from hudepth.models.options import ACTIVATIONS, choose

CPU = torch.device("cpu")


def sine_positions(channels: int, height: int, width: int, *, device: torch.device = CPU) -> Float[Tensor, "c h w"]:
    """Return sines and cosines of row and column, each over half the channels (Carion et al. 2020, DETR), in float64.

    On a device without float64 they are float32.

    Half of each half are sines, half cosines, of angles that fall geometrically from 1 to 1/10000 per pixel (Vaswani et
    al. 2017). ``channels``: a multiple of 4.
    """
    count = channels // 4
    steps = torch.arange(max(count, height, width), dtype=widest_float(device), device=device)
    frequency = torch.exp(steps[:count] * (-math.log(10_000) / count))[:, None]
    rows, columns = (frequency * steps[:length] for length in (height, width))  # [c/4, length]
    rows = torch.cat([rows.sin(), rows.cos()])[:, :, None].expand(-1, -1, width)
    columns = torch.cat([columns.sin(), columns.cos()])[:, None, :].expand(-1, height, -1)
    return torch.cat([rows, columns])


class TransformerBlock(nn.Module):
    """Post-norm self-attention over the positions of a map: x = LN(x + MHA(x)); x = LN(x + FFN(x)).

    Args:
        channels: width of a token.
        heads: attention heads; must divide ``channels``. The paper does not state it.
        expansion: width of the feed-forward layer over that of a token (table A1: 4).
        activation: of the feed-forward layer: relu, gelu or silu. The paper does not state it.
        positions: "none" (figure 4 shows no encoding), or "sine", which is added to queries and keys and needs a
            multiple of 4 channels. Neither has parameters: table A1 counts none.

    Raises:
        ConfigError: if ``heads`` does not divide ``channels``, or the activation or the encoding is unknown.
    """

    def __init__(
        self, channels: int, *, heads: int = 8, expansion: int = 4, activation: str = "relu", positions: str = "none"
    ) -> None:
        super().__init__()
        self.positions = convert("model.attention_positions", positions, Literal["none", "sine"], default="none")
        if heads < 1 or channels % heads:
            usable = [n for n in (1, 2, 4, 8, 16, 32, 64) if channels % n == 0]
            raise ConfigError(
                f"model.attention_heads: {heads} heads do not divide {channels} channels. Pass one of {usable}."
            )
        self.attention = nn.MultiheadAttention(channels, heads, batch_first=True)
        self.norm1 = nn.LayerNorm(channels)
        self.feed_forward = nn.Sequential(
            nn.Linear(channels, expansion * channels),
            choose("model.attention_activation", activation, ACTIVATIONS)(),
            nn.Linear(expansion * channels, channels),
        )
        self.norm2 = nn.LayerNorm(channels)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Attend from every position of the map to every other."""
        tokens: Tensor = x.flatten(2).transpose(1, 2)
        queries = tokens
        if self.positions == "sine":  # not added to the values: they reach the decoder
            encoding = sine_positions(*x.shape[1:], device=x.device).to(x.dtype)
            queries = tokens + encoding.flatten(1).T
        tokens = self.norm1(tokens + self.attention(queries, queries, tokens, need_weights=False)[0])
        tokens = self.norm2(tokens + self.feed_forward(tokens))
        return tokens.transpose(1, 2).reshape(x.shape)


class PooledContext(nn.Module):
    """Adds to each position what the mean over all says: depth depends on the whole scene (as in ParseNet, 2015)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(channels, channels // 2, 1), nn.ReLU(inplace=True), nn.Conv2d(channels // 2, channels, 1)
        )

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Return a map of the same shape."""
        result: Tensor = x + self.layers(x.mean(dim=(2, 3), keepdim=True))
        return result


class ScaleHead(nn.Module):
    """One number per image, from the mean of its deepest map: what the whole depth map is shifted by before its output.

    Through a sigmoid, small depths are multiplied by its exponential. It starts at 0.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(channels, channels // 2, 1), nn.ReLU(inplace=True), nn.Conv2d(channels // 2, 1, 1)
        )
        for parameter in self.layers[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 1 1"]:
        """Return the shift."""
        shift: Tensor = self.layers(x.mean(dim=(2, 3), keepdim=True))
        return shift
