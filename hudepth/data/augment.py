"""Augmentation of image and depth together, for whole batches, on whatever device they are.

What moves pixels moves both alike, and what changes the scale of an image changes its depth: in a crop that is enlarged
by z, everything looks z times as near to the same camera, so depth is divided by z (Eigen et al. 2014, section 3.4).
Colours change the image alone. CutDepth (Ishii and Yamashita 2021) shows the network a piece of the truth in its place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from hudepth.base.errors import ConfigError
from hudepth.losses.badcl import BT601_LUMA

MAX_BLUR = 3.0
"""Largest standard deviation of the blur [pixels]."""


@dataclass(frozen=True)
class Geometry:
    """How each image of a batch is moved; see :func:`warp`."""

    zoom: Float[Tensor, " b"]
    """How many times the crop is enlarged, at least 1."""
    centre: Float[Tensor, "b 2"]
    """Of the crop, x and y in [-1, 1] of the image's halves."""
    angle: Float[Tensor, " b"]
    """By which the camera is rolled [radians], clockwise."""
    flip: Bool[Tensor, " b"]
    """Left and right swapped."""


def warp(
    image: Float[Tensor, "b 3 h w"],
    depth: Float[Tensor, "b d h w"],
    geometry: Geometry,
    *,
    size: tuple[int, int],
    aspect: float,
) -> tuple[Float[Tensor, "b 3 h2 w2"], Float[Tensor, "b d h2 w2"]]:
    """Crop, zoom, roll and flip images and depths, and resize them.

    Images are interpolated linearly; depth takes the nearest pixel, since the mean of two surfaces is the depth of
    neither. Beyond the image's edge, colours go on and depth is unmeasured. Rolling and moving the crop leave depth
    along the optical axis as it is; zooming divides it.

    Args:
        image: in any unit.
        depth: one or more maps in any unit, 0 where unmeasured.
        geometry: what to do with each image.
        size: (height, width) of the result.
        aspect: width over height of the scene that the image shows: a roll is one in the scene, also where images are
            stretched to another shape.

    Returns:
        Images and depths of ``size``.
    """
    cos, sin = geometry.angle.cos() / geometry.zoom, geometry.angle.sin() / geometry.zoom
    mirror = torch.where(geometry.flip, -1.0, 1.0).to(cos)
    along_x = torch.stack([cos * mirror, sin * aspect * mirror], dim=1)
    along_y = torch.stack([-sin / aspect, cos], dim=1)
    grid = _affine_grid(along_x, along_y, geometry.centre, size)
    image = _at_most_twice(image, size)
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
    """Cut a share of each side off, and of a pixel that is partly in it the whole."""
    top, left = (math.ceil(border * side - 1e-6) for side in image.shape[-2:])
    height, width = image.shape[-2] - 2 * top, image.shape[-1] - 2 * left
    return tuple(x.narrow(-2, top, height).narrow(-1, left, width) for x in (image, depth))  # type: ignore[return-value]


def resize(
    image: Float[Tensor, "b 3 h w"], depth: Float[Tensor, "b d h w"], *, size: tuple[int, int]
) -> tuple[Float[Tensor, "b 3 h2 w2"], Float[Tensor, "b d h2 w2"]]:
    """Resize images by the mean of areas, depths to the nearest pixel; return what has this size as it is."""
    if image.shape[-2:] == size:
        return image, depth
    return functional.interpolate(image, size, mode="area"), functional.interpolate(depth, size, mode="nearest-exact")


def _at_most_twice(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Shrink what is more than twice as large as ``size``: linear interpolation would leave pixels out."""
    target = [min(have, 2 * want) for have, want in zip(image.shape[-2:], size, strict=True)]
    return image if target == list(image.shape[-2:]) else functional.interpolate(image, target, mode="area")


def change_colours(
    image: Float[Tensor, "b 3 h w"],
    *,
    gamma: Float[Tensor, " b"],
    brightness: Float[Tensor, " b"],
    contrast: Float[Tensor, " b"],
    saturation: Float[Tensor, " b"],
    tint: Float[Tensor, "b 3"],
) -> Float[Tensor, "b 3 h w"]:
    """Change the colours of images in [0, 1]; each factor is one for each image and 1 leaves it as it is.

    In this order: x ** gamma, times brightness and tint, away from the image's mean by contrast, away from grey by
    saturation; the result is clipped to [0, 1].

    Args:
        image: RGB in [0, 1].
        gamma: exponent.
        brightness: factor.
        contrast: factor of the difference from the mean luma of the image.
        saturation: factor of the difference from each pixel's luma.
        tint: factor of each channel.
    """
    image = image.clamp(1e-4, 1).pow_(gamma[:, None, None, None])
    # What follows is linear in the colours of a pixel: one matrix and one offset for each image.
    # Constants are made where they are used: to copy them there, a GPU would have to be waited for.
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
    """Blur each image by a Gaussian of its own standard deviation.

    Args:
        image: in any unit.
        sigma: standard deviations [pixels]; 0 leaves an image as it is.
        largest: that sigma can be; the Gaussians end at two of it.
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
    """Show the truth in a box of each image (CutDepth, Ishii and Yamashita 2021), as grey in [0, 1].

    Args:
        image: RGB in [0, 1].
        unit_depth: in [0, 1], 0 where unmeasured: there the image stays.
        box: left, top, right, bottom as shares of the image's sides; an empty box changes nothing.
    """
    height, width = image.shape[-2:]
    y = (torch.arange(height, device=image.device) + 0.5)[:, None] / height
    x = (torch.arange(width, device=image.device) + 0.5)[None, :] / width
    left, top, right, bottom = (side[:, None, None] for side in box.unbind(dim=1))
    inside = ((x >= left) & (x < right) & (y >= top) & (y < bottom))[:, None]
    return torch.where(inside & (unit_depth > 0), unit_depth, image)


class Augmentation:
    """Random changes of training pairs, drawn for each image; what is 0, or a range that is a point, is left out.

    Args:
        flip: probability of swapping left and right.
        zoom: range of the crop's enlargement, at least 1; its logarithm is uniform. The crop lies anywhere.
        zoom_chance: probability of zooming at all; else the whole image is seen.
        zoom_depth: divide depth by the zoom, as a fixed camera would see it; false leaves depth as it is.
        rotate_deg: the camera is rolled by up to this, either way [degrees]; at most 45.
        border: share of each side that is never looked at, in [0, 0.4].
        gamma: range of the exponent of colours in [0, 1].
        brightness: range of their factor.
        contrast: range of the factor of their difference from the image's mean.
        saturation: range of the factor of their difference from grey.
        tint: each channel's factor is within 1 - tint and 1 + tint.
        grey: probability of losing all colour.
        noise: largest standard deviation of noise, of colours in [0, 1].
        blur: largest standard deviation of blur [pixels at training size], at most 3.
        cut_depth: probability of showing the truth in a box of the image.
        cut_depth_size: largest share of what is right of and below the box's corner that the box takes, in [0, 1].

    Raises:
        ConfigError: for values out of range, or such as would leave no pixel.
    """

    def __init__(
        self,
        *,
        flip: float = 0.0,
        zoom: Sequence[float] = (1.0, 1.0),
        zoom_chance: float = 1.0,
        zoom_depth: bool = True,
        rotate_deg: float = 0.0,
        border: float = 0.0,
        gamma: Sequence[float] = (1.0, 1.0),
        brightness: Sequence[float] = (1.0, 1.0),
        contrast: Sequence[float] = (1.0, 1.0),
        saturation: Sequence[float] = (1.0, 1.0),
        tint: float = 0.0,
        grey: float = 0.0,
        noise: float = 0.0,
        blur: float = 0.0,
        cut_depth: float = 0.0,
        cut_depth_size: float = 0.75,
    ) -> None:
        for key, value, most in (
            ("flip", flip, 1.0), ("zoom_chance", zoom_chance, 1.0), ("grey", grey, 1.0), ("cut_depth", cut_depth, 1.0),
            ("cut_depth_size", cut_depth_size, 1.0), ("tint", tint, 0.5), ("noise", noise, 1.0),
            ("blur", blur, MAX_BLUR), ("rotate_deg", rotate_deg, 45.0),
        ):  # fmt: skip
            if not 0 <= value <= most:
                raise ConfigError(f"augment.{key}: {value} is not in [0, {most:g}].")
        if not 0 <= border <= 0.4:
            raise ConfigError(
                f"augment.border: {border} of each side would leave {max(0.0, 1 - 2 * border):.0%} of an image. "
                "Pass at most 0.4; of NYU's labelled set 0.02 covers the white frame."
            )
        self.zoom = _range("zoom", zoom, least=1.0, most=8.0)
        self.gamma = _range("gamma", gamma, least=0.1, most=10.0)
        self.brightness = _range("brightness", brightness, least=0.0, most=10.0)
        self.contrast = _range("contrast", contrast, least=0.0, most=10.0)
        self.saturation = _range("saturation", saturation, least=0.0, most=10.0)
        self.zoom_chance = zoom_chance
        self.flip, self.zoom_depth, self.rotate, self.border = flip, zoom_depth, math.radians(rotate_deg), border
        self.tint, self.grey, self.noise, self.blur = tint, grey, noise, blur
        self.cut_depth, self.cut_depth_size = cut_depth, cut_depth_size
        self._moves = flip > 0 or self.zoom != (1.0, 1.0) or rotate_deg > 0
        self._colours = (
            tint > 0
            or grey > 0
            or any(span != (1.0, 1.0) for span in (self.gamma, self.brightness, self.contrast, self.saturation))
        )

    def __call__(
        self,
        image: Float[Tensor, "b 3 h w"],
        unit_depth: Float[Tensor, "b d h w"],
        *,
        size: tuple[int, int],
        aspect: float,
        generator: torch.Generator,
    ) -> tuple[Float[Tensor, "b 3 h2 w2"], Float[Tensor, "b d h2 w2"]]:
        """Change a batch.

        Args:
            image: RGB in [0, 1].
            unit_depth: depth / max_depth_m, not clipped, 0 where unmeasured: the truth, then what is moved with it.
            size: (height, width) of the result.
            aspect: width over height of what the images show.
            generator: of the CPU, whatever device the batch is on: the same draws everywhere.
        """
        draw = _Draw(len(image), generator, image.device)
        image, unit_depth = cut_border(image, unit_depth, self.border)
        if self._moves:
            geometry = self._draw_geometry(draw)
            image, unit_depth = warp(image, unit_depth, geometry, size=size, aspect=aspect)
            if not self.zoom_depth:
                unit_depth = unit_depth * geometry.zoom[:, None, None, None]
        else:
            image, unit_depth = resize(image, unit_depth, size=size)
        if self.blur:
            image = self._blur(image, draw.uniform(-self.blur, self.blur))
        if self._colours:
            image = change_colours(
                image,
                gamma=draw.log_uniform(*self.gamma),
                brightness=draw.uniform(*self.brightness),
                contrast=draw.uniform(*self.contrast),
                saturation=draw.uniform(*self.saturation) * ~draw.chance(self.grey),
                tint=1 + self.tint * torch.stack([draw.uniform(-1, 1) for _ in range(3)], dim=1),
            )
        if self.noise:
            sigma = draw.uniform(0, self.noise)[:, None, None, None]
            image = draw.normal_like(image).mul_(sigma).add_(image).clamp_(0, 1)
        if self.cut_depth:
            image = cut_depth(image, unit_depth[:, :1].clamp(max=1), self._draw_box(draw))
        return image, unit_depth

    def _blur(self, image: Tensor, sigma: Tensor) -> Tensor:
        """Blur images; where sigma is negative, which is half of them, they stay sharp."""
        if image.device.type != "cpu":  # to ask which, a GPU would have to be waited for
            return blur(image, sigma.clamp_min(0), largest=self.blur)
        rows = (sigma > 0).nonzero()[:, 0]
        return image.index_copy(0, rows, blur(image[rows], sigma[rows], largest=self.blur)) if len(rows) else image

    def _draw_geometry(self, draw: _Draw) -> Geometry:
        zoom = torch.where(draw.chance(self.zoom_chance), draw.log_uniform(*self.zoom), 1.0)
        room = 1 - 1 / zoom
        return Geometry(
            zoom=zoom,
            centre=torch.stack([room * draw.uniform(-1, 1), room * draw.uniform(-1, 1)], dim=1),
            angle=draw.uniform(-self.rotate, self.rotate),
            flip=draw.chance(self.flip),
        )

    def _draw_box(self, draw: _Draw) -> Tensor:
        shown = draw.chance(self.cut_depth)
        left, top = draw.uniform(0, 1), draw.uniform(0, 1)
        wide, high = (self.cut_depth_size * draw.uniform(0, 1) * shown for _ in range(2))
        return torch.stack([left, top, left + (1 - left) * wide, top + (1 - top) * high], dim=1)


class _Draw:
    """Random numbers, one for each image: drawn on the CPU, used on the device."""

    def __init__(self, count: int, generator: torch.Generator, device: torch.device) -> None:
        self.count, self.generator, self.device = count, generator, device

    def uniform(self, low: float, high: float) -> Tensor:
        numbers = torch.rand(self.count, generator=self.generator)
        return (low + (high - low) * numbers).to(self.device, non_blocking=True)

    def log_uniform(self, low: float, high: float) -> Tensor:
        return self.uniform(math.log(low), math.log(high)).exp()

    def chance(self, probability: float) -> Tensor:
        return self.uniform(0, 1) < probability

    def normal_like(self, x: Tensor) -> Tensor:
        seed = int(torch.randint(2**62, (), generator=self.generator))
        return torch.randn(x.shape, generator=torch.Generator(x.device).manual_seed(seed), device=x.device)


def _range(key: str, values: Sequence[float], *, least: float, most: float) -> tuple[float, float]:
    usual = isinstance(values, Sequence) and len(values) == 2 and all(isinstance(x, int | float) for x in values)
    if not usual or not least <= values[0] <= values[1] <= most:
        raise ConfigError(
            f"augment.{key}: {list(values) if isinstance(values, Sequence) else values!r} is not [lowest,highest] "
            f"within [{least:g}, {most:g}]. Pass augment.{key}=[1,1] to leave it out."
        )
    return float(values[0]), float(values[1])
