"""A network small enough to train in milliseconds: for tests, debugging and smoke runs, not for depth."""

from __future__ import annotations

from typing import Annotated

from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.options import Range, convert
from hudepth.models.unet import check_size

STRIDE = 16


class TinyUNet(nn.Module):
    """A few thousand parameters with the hybrid UNet's interface.

    ``channels``, at least 1, else a ConfigError is raised, is the width of its only hidden layer.
    """

    def __init__(self, *, channels: int = 8) -> None:
        super().__init__()
        convert("model.channels", channels, Annotated[int, Range(1)])
        self.encode = nn.Conv2d(3, channels, STRIDE, stride=STRIDE)
        self.norm = nn.BatchNorm2d(channels)
        self.relu = nn.ReLU()
        self.decode = nn.ConvTranspose2d(channels, 1, STRIDE, stride=STRIDE)
        self.output = nn.Sigmoid()

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Predict unit depth in [0, 1]; raises ConfigError if a side of the image is not a multiple of 16."""
        check_size(*image.shape[-2:], stride=STRIDE)
        unit_depth: Tensor = self.output(self.decode(self.relu(self.norm(self.encode(image)))))
        return unit_depth
