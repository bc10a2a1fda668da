"""The network with its pre- and post-processing: bytes in, metres out. This is also the graph that is exported."""

from __future__ import annotations

from jaxtyping import Float, UInt8
from torch import Tensor, nn

from hudepth.base.normalise import NormaliseBytes


class DepthPipeline(nn.Module):
    """RGB bytes at the network's size to depth in metres.

    Args:
        net: normalised image to unit depth.
        max_depth_m: maximum depth [m]; the network predicts depth / max_depth_m.
    """

    def __init__(self, net: nn.Module, *, max_depth_m: float) -> None:
        super().__init__()
        self.normalise, self.net, self.max_depth_m = NormaliseBytes(), net, max_depth_m

    def forward(self, image: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b h w"]:
        """Predict depth [m], never below 0."""
        depth: Tensor = self.net(self.normalise(image))[:, 0] * self.max_depth_m
        return depth.clamp(min=0)
