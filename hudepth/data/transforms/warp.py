"""Move the pixels of images and depths together: crop, zoom, roll, flip, resize.

In a crop that is enlarged by z, everything looks z times as near to the same camera, so depth is divided by z (Eigen et
al. 2014, section 3.4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class Geometry:
    """How each image of a batch is cropped, rolled and flipped; see :func:`warp`.

    ``zoom`` enlarges the crop, and below 1 shrinks the image; ``centre`` is its x and y, where [-1, 1] spans the image;
    ``angle`` is the roll of the camera [radians], clockwise; ``flip`` swaps left and right.
    """

    zoom: Float[Tensor, " b"]
    centre: Float[Tensor, "b 2"]
    angle: Float[Tensor, " b"]
    flip: Bool[Tensor, " b"]


def warp(
    image: Float[Tensor, "b 3 h w"],
    depth: Float[Tensor, "b d h w"],
    geometry: Geometry,
    *,
    size: tuple[int, int],
    aspect: float,
    least_zoom: float = 1.0,
) -> tuple[Float[Tensor, "b 3 h2 w2"], Float[Tensor, "b d h2 w2"]]:
    """Crop, zoom, roll and flip images and depths (0 where unmeasured) in any units, and resize them to ``size``.

    Images are interpolated linearly; depth takes the nearest pixel, since the mean of two surfaces is the depth of
    neither. Beyond the image's edge, colours are repeated and depth is unmeasured. Zooming divides depth; rolling and
    moving the crop do not change depth along the optical axis. ``aspect`` is width over height of the scene, so that a
    roll is a rotation even if images were stretched to another shape. No zoom is below ``least_zoom``.
    """
    cos, sin = geometry.angle.cos() / geometry.zoom, geometry.angle.sin() / geometry.zoom
    mirror = torch.where(geometry.flip, -1.0, 1.0).to(cos)
    along_x = torch.stack([cos * mirror, sin * aspect * mirror], dim=1)
    along_y = torch.stack([-sin / aspect, cos], dim=1)
    grid = _affine_grid(along_x, along_y, geometry.centre, size)
    image = _at_most_twice(image, size, zoom=min(least_zoom, 1.0))
    image = functional.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)
    depth = functional.grid_sample(depth, grid, mode="nearest", padding_mode="zeros", align_corners=False)
    return image, depth / geometry.zoom[:, None, None, None]


def _affine_grid(along_x: Tensor, along_y: Tensor, centre: Tensor, size: tuple[int, int]) -> Tensor:
    """Return centre + x * along_x + y * along_y for the pixels of an image, [b, h, w, 2] of vectors [b, 2].

    (:func:`torch.nn.functional.affine_grid` multiplies matrices pixel by pixel, which takes 20 times as long.)
    """
    height, width = ((2 * torch.arange(n, device=centre.device) + 1) / n - 1 for n in size)
    columns = width[:, None] * along_x[:, None, :]
    rows = height[:, None] * along_y[:, None, :] + centre[:, None, :]
    return rows[:, :, None, :] + columns[:, None, :, :]


def cut_border(
    image: Float[Tensor, "b 3 h w"], depth: Float[Tensor, "b d h w"], border: float
) -> tuple[Float[Tensor, "b 3 h2 w2"], Float[Tensor, "b d h2 w2"]]:
    """Cut a share off each side, rounded up to whole pixels."""
    top, left = (math.ceil(border * side - 1e-6) for side in image.shape[-2:])
    height, width = image.shape[-2] - 2 * top, image.shape[-1] - 2 * left
    return tuple(x.narrow(-2, top, height).narrow(-1, left, width) for x in (image, depth))  # type: ignore[return-value]


def resize(
    image: Float[Tensor, "b 3 h w"], depth: Float[Tensor, "b d h w"], *, size: tuple[int, int]
) -> tuple[Float[Tensor, "b 3 h2 w2"], Float[Tensor, "b d h2 w2"]]:
    """Resize images by averaging areas, depths by taking the nearest pixel, unless they have this size already."""
    if image.shape[-2:] == size:
        return image, depth
    return functional.interpolate(image, size, mode="area"), functional.interpolate(depth, size, mode="nearest-exact")


def _at_most_twice(image: Tensor, size: tuple[int, int], *, zoom: float) -> Tensor:
    """Shrink images more than twice as large as ``size`` times ``zoom``: linear interpolation would skip pixels."""
    target = [min(have, math.ceil(2 * want * zoom)) for have, want in zip(image.shape[-2:], size, strict=True)]
    return image if target == list(image.shape[-2:]) else functional.interpolate(image, target, mode="area")
