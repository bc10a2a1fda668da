"""The transformer block of section 3.1 and figure 4, over the positions of a feature map."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from hudepth.errors import ConfigError
from hudepth.models.options import ACTIVATIONS, choose


class TransformerBlock(nn.Module):
    """Post-norm self-attention: x = LN(x + MHA(x)); x = LN(x + FFN(x)).

    The positions of the map are the tokens; no positional encoding, since table A1 counts no parameter for one.

    Args:
        channels: width of a token.
        heads: attention heads; must divide ``channels``. The paper does not state it.
        expansion: width of the feed-forward layer over that of a token (table A1: 4).
        activation: of the feed-forward layer: relu, gelu or silu. The paper does not state it.

    Raises:
        ConfigError: if ``heads`` does not divide ``channels`` or the activation is unknown.
    """

    def __init__(self, channels: int, *, heads: int = 8, expansion: int = 4, activation: str = "relu") -> None:
        super().__init__()
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
        """Let every position of the map look at every other."""
        tokens: Tensor = x.flatten(2).transpose(1, 2)
        tokens = self.norm1(tokens + self.attention(tokens, tokens, tokens, need_weights=False)[0])
        tokens = self.norm2(tokens + self.feed_forward(tokens))
        return tokens.transpose(1, 2).reshape(x.shape)
