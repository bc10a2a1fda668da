"""How steep a map is: the 3 x 3 Sobel filter, as losses and metrics of depth edges use it."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor


def squared_sobel(x: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 1 rows columns"]:
    """Return fx^2 + fy^2 at each pixel but the border's; fx and fy are plain sums, of weights 1 2 1."""
    smooth = x[..., :-2, :] + 2 * x[..., 1:-1, :] + x[..., 2:, :]
    across = smooth[..., 2:] - smooth[..., :-2]
    smooth = x[..., :-2] + 2 * x[..., 1:-1] + x[..., 2:]
    down = smooth[..., 2:, :] - smooth[..., :-2, :]
    return across.square() + down.square()


def whole_neighbourhoods(valid: Bool[Tensor, "b 1 h w"]) -> Bool[Tensor, "b 1 rows columns"]:
    """Return whether the 3 x 3 pixels around each pixel but the border's are all valid."""
    rows = valid[..., :-2, :] & valid[..., 1:-1, :] & valid[..., 2:, :]
    return rows[..., :-2] & rows[..., 1:-1] & rows[..., 2:]
