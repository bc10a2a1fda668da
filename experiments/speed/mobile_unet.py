"""A network of MobileNet's class: separable convolutions throughout, after FastDepth (Wofk et al. 2019)."""

from __future__ import annotations

import itertools

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

ENCODER = (
    ((64, 1),),
    ((128, 2), (128, 1)),
    ((256, 2), (256, 1)),
    ((512, 2), (512, 1), (512, 1), (512, 1), (512, 1), (512, 1)),
    ((1024, 2), (1024, 1)),
)
"""Channels and stride of MobileNet V1's separable convolutions, by the resolution they end at."""
DECODER = (512, 256, 128, 64, 32)


def separable(channels_in: int, channels_out: int, *, kernel: int, stride: int = 1) -> nn.Sequential:
    """Return a depthwise and a pointwise convolution, each with batch norm and ReLU."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_in, kernel, stride, kernel // 2, groups=channels_in, bias=False),
        nn.BatchNorm2d(channels_in),
        nn.ReLU(inplace=True),
        nn.Conv2d(channels_in, channels_out, 1, bias=False),
        nn.BatchNorm2d(channels_out),
        nn.ReLU(inplace=True),
    )


class MobileUNet(nn.Module):
    """MobileNet V1, and a decoder of 5 x 5 depthwise convolutions with nearest upsampling and added skips.

    3,960,929 parameters; sides must be multiples of 32.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(3, 32, 3, 2, 1, bias=False), nn.BatchNorm2d(32), nn.ReLU(inplace=True)
        )  # fmt: skip
        channels, stages = 32, []
        for stage in ENCODER:
            layers = []
            for wider, stride in stage:
                layers.append(separable(channels, wider, kernel=3, stride=stride))
                channels = wider
            stages.append(nn.Sequential(*layers))
        self.encoder = nn.ModuleList(stages)
        widths = (channels, *DECODER)
        self.decoder = nn.ModuleList(separable(*pair, kernel=5) for pair in itertools.pairwise(widths))
        self.head = nn.Conv2d(DECODER[-1], 1, 1)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Predict a map of the image's size."""
        x, skips = self.stem(image), []
        for stage in self.encoder:
            x = stage(x)
            skips.append(x)
        for block, skip in zip(self.decoder, [*skips[-2::-1], None], strict=True):
            x = functional.interpolate(block(x), scale_factor=2, mode="nearest")
            x = x if skip is None else x + skip
        depth: Tensor = self.head(x)
        return depth
