"""ImageNet's mean and standard deviation, and the only code that applies them."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

IMAGENET_MEAN = (0.485, 0.456, 0.406)
"""Mean of ImageNet's training images, RGB in [0, 1]."""
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Standard deviation of the same."""

# Channel by channel with plain floats: a tensor of statistics would cost each call a copy to the device.


def normalise_image(image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Return the RGB ``image`` in [0, 1] less ImageNet's mean, divided by its standard deviation."""
    channels = zip(image.unbind(dim=1), IMAGENET_MEAN, IMAGENET_STD, strict=True)
    return torch.stack([(channel - mean) / std for channel, mean, std in channels], dim=1)


def denormalise_image(image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Return the ImageNet-normalised RGB ``image`` in [0, 1]: the inverse of :func:`normalise_image`."""
    channels = zip(image.unbind(dim=1), IMAGENET_MEAN, IMAGENET_STD, strict=True)
    return torch.stack([channel * std + mean for channel, mean, std in channels], dim=1)


class NormaliseBytes(nn.Module):
    """RGB bytes to the same normalised image, laid out channels-last as the bytes are."""

    scale: Tensor
    shift: Tensor

    def __init__(self) -> None:
        super().__init__()
        mean, std = (torch.tensor(values, dtype=torch.float64) for values in (IMAGENET_MEAN, IMAGENET_STD))
        # (x / 255 - mean) / std as one multiplication and one addition; buffers move to the device once
        self.register_buffer("scale", (1 / (255 * std)).float(), persistent=False)
        self.register_buffer("shift", (-mean / std).float(), persistent=False)

    def forward(self, rgb: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b 3 h w"]:
        """Return the normalised image."""
        return (rgb.float() * self.scale + self.shift).permute(0, 3, 1, 2)
