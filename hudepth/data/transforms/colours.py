"""Change the colours of images, on whatever device they are: gamma, contrast, blur, CutDepth."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from hudepth.losses.badcl import BT601_LUMA

MAX_BLUR = 3.0
"""Largest standard deviation of the blur [pixels]."""


def change_colours(
    image: Float[Tensor, "b 3 h w"],
    *,
    gamma: Float[Tensor, " b"],
    brightness: Float[Tensor, " b"],
    contrast: Float[Tensor, " b"],
    saturation: Float[Tensor, " b"],
    tint: Float[Tensor, "b 3"],
) -> Float[Tensor, "b 3 h w"]:
    """Change the colours of images in [0, 1] by factors per image; 1 changes nothing.

    In this order: x ** gamma, times brightness and tint, away from the image's mean by contrast, away from grey by
    saturation; the result is clipped to [0, 1]. Contrast scales the difference from the image's mean luma, saturation
    that from each pixel's luma.
    """
    image = image.clamp(1e-4, 1).pow_(gamma[:, None, None, None])
    # The rest is linear in the colours of a pixel: one matrix and one offset per image.
    # Constants are created on the device: copying them there would wait for the GPU.
    weights = torch.stack([torch.full_like(gamma[0], weight) for weight in BT601_LUMA])
    eye = torch.eye(3, dtype=image.dtype, device=image.device)
    scale = brightness[:, None] * tint
    mean = (scale * image.mean(dim=(2, 3))) @ weights
    saturate = torch.lerp(weights.expand(3, 3), eye, saturation[:, None, None])
    matrix = saturate * (contrast[:, None] * scale)[:, None, :]
    offset = ((1 - contrast) * mean)[:, None, None].expand(-1, 3, 1)
    return torch.baddbmm(offset, matrix, image.flatten(2)).reshape(image.shape).clamp_(0, 1)


def blur(
    image: Float[Tensor, "b c h w"], sigma: Float[Tensor, " b"], *, largest: float = MAX_BLUR
) -> Float[Tensor, "b c h w"]:
    """Blur each image by a Gaussian of its own standard deviation ``sigma`` [pixels]; 0 changes nothing.

    ``largest`` is an upper bound of sigma; the Gaussians are cut off at twice this.
    """
    radius = math.ceil(2 * largest)
    taps = torch.arange(-radius, radius + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (taps / sigma.clamp(0.05, largest)[:, None]).square())  # at 0.05 all but the centre is 0
    kernel = kernel / kernel.sum(dim=1, keepdim=True)
    batch, channels, height, width = image.shape
    kernel = kernel.repeat_interleave(channels, dim=0)[:, None]
    x = image.reshape(1, batch * channels, height, width)
    for shape, pad in ((kernel[:, :, None], (radius, radius, 0, 0)), (kernel[..., None], (0, 0, radius, radius))):
        x = functional.conv2d(functional.pad(x, pad, mode="replicate"), shape, groups=batch * channels)
    return x.reshape(image.shape)


def cut_depth(
    image: Float[Tensor, "b 3 h w"], unit_depth: Float[Tensor, "b 1 h w"], box: Float[Tensor, "b 4"]
) -> Float[Tensor, "b 3 h w"]:
    """Replace a box of each image by its ground truth, as grey in [0, 1] (CutDepth, Ishii and Yamashita 2021).

    Where ``unit_depth`` (in [0, 1]) is 0, unmeasured, the image is kept. A box is left, top, right and bottom as shares
    of the image's sides; an empty one changes nothing.
    """
    height, width = image.shape[-2:]
    y = (torch.arange(height, device=image.device) + 0.5)[:, None] / height
    x = (torch.arange(width, device=image.device) + 0.5)[None, :] / width
    left, top, right, bottom = (side[:, None, None] for side in box.unbind(dim=1))
    inside = ((x >= left) & (x < right) & (y >= top) & (y < bottom))[:, None]
    return torch.where(inside & (unit_depth > 0), unit_depth, image)
