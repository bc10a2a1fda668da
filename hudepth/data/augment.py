"""Random augmentation of image and depth together, for whole batches, on whatever device they are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from hudepth.base.errors import ConfigError
from hudepth.base.machine import copy_to
from hudepth.base.options import Range, check
from hudepth.data.transforms.colours import MAX_BLUR, blur, change_colours, cut_depth
from hudepth.data.transforms.warp import Geometry, cut_border, resize, warp

_Share = Annotated[float, Range(0, 1)]
_Factor = Annotated[Sequence[float], Range(0, 10), "[lowest,highest] within 0 and 10"]
_DRAWS = 21
"""Random numbers that an image takes if everything is changed."""
_SPANS = ("zoom", "gamma", "brightness", "contrast", "saturation")


@dataclass(kw_only=True, eq=False)
class Augmentation:
    """Random changes of training pairs, drawn for each image; by default none. ConfigError for values out of range.

    Args:
        flip: probability of swapping left and right.
        zoom: range of the crop's enlargement; its logarithm is uniform. The crop lies anywhere. Below 1 the whole image
            is shrunk instead, as a wider lens shows it, and lies anywhere; around it nothing is measured.
        zoom_chance: probability of zooming at all; otherwise the whole image is used.
        zoom_depth: divide depth by the zoom, as a fixed camera would see it.
        rotate_deg: largest roll of the camera, either way [degrees]; at most 45.
        border: share of each side that is cut off, in [0, 0.4]; 0.02 covers the white frame of NYU's labelled set.
        gamma, brightness: ranges of the exponent and the factor of colours in [0, 1].
        contrast, saturation: ranges of the factors of their difference from the image's mean and from grey.
        tint: each channel's factor is within 1 - tint and 1 + tint.
        grey: probability of removing all colour.
        noise: largest standard deviation of noise, of colours in [0, 1].
        blur: largest standard deviation of blur [pixels at training size], at most 3.
        cut_depth: probability of showing the ground truth in a box of the image.
        cut_depth_size: largest share of what is right of and below the box's corner that the box takes.

    """

    flip: _Share = 0.0
    zoom: Annotated[Sequence[float], Range(0.5, 8), "[lowest,highest] within 0.5 and 8"] = (1.0, 1.0)
    zoom_chance: _Share = 1.0
    zoom_depth: bool = True
    rotate_deg: Annotated[float, Range(0, 45)] = 0.0
    border: Annotated[float, Range(0, 0.4)] = 0.0
    gamma: Annotated[Sequence[float], Range(0.1, 10), "[lowest,highest] within 0.1 and 10"] = (1.0, 1.0)
    brightness: _Factor = (1.0, 1.0)
    contrast: _Factor = (1.0, 1.0)
    saturation: _Factor = (1.0, 1.0)
    tint: Annotated[float, Range(0, 0.5)] = 0.0
    grey: _Share = 0.0
    noise: _Share = 0.0
    blur: Annotated[float, Range(0, MAX_BLUR)] = 0.0
    cut_depth: _Share = 0.0
    cut_depth_size: _Share = 0.75

    def __post_init__(self) -> None:
        check(self, prefix="augment.")
        for key in _SPANS:
            span = getattr(self, key)
            if len(span) != 2 or span[0] > span[1]:
                found = ",".join(f"{value:g}" for value in span)
                raise ConfigError(f"augment.{key}: [{found}] is not [lowest,highest]. Pass [1,1] to leave it out.")
        changed = {key for key in _SPANS if tuple(getattr(self, key)) != (1.0, 1.0)}
        self._moves = self.flip > 0 or self.rotate_deg > 0 or "zoom" in changed
        self._colours = self.tint > 0 or self.grey > 0 or bool(changed - {"zoom"})

    def __call__(
        self,
        image: Float[Tensor, "b 3 h w"],
        unit_depth: Float[Tensor, "b d h w"],
        *,
        size: tuple[int, int],
        aspect: float,
        generator: torch.Generator,
    ) -> tuple[Float[Tensor, "b 3 h2 w2"], Float[Tensor, "b d h2 w2"]]:
        """Draw random numbers and :meth:`apply` them; ``generator`` as in :meth:`draw`."""
        draws = self.draw(len(image), size=size, generator=generator, device=image.device)
        return self.apply(image, unit_depth, size=size, aspect=aspect, draws=draws)

    def draw(
        self, count: int, *, size: tuple[int, int], generator: torch.Generator, device: torch.device
    ) -> dict[str, Tensor]:
        """Draw all random numbers for ``count`` images, from a generator of the CPU: the same ones on every device.

        Returns:
            ``numbers`` [n, count], uniform in [0, 1), and if there is noise, ``noise`` ``[count, 3, *size]``, normal.
        """
        draws = {"numbers": copy_to(torch.rand(_DRAWS, count, generator=generator), device)}
        if self.noise:
            there = torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=generator)))
            draws["noise"] = torch.randn(count, 3, *size, generator=there, device=device)
        return draws

    def apply(
        self,
        image: Float[Tensor, "b 3 h w"],
        unit_depth: Float[Tensor, "b d h w"],
        *,
        size: tuple[int, int],
        aspect: float,
        draws: Mapping[str, Tensor],
    ) -> tuple[Float[Tensor, "b 3 h2 w2"], Float[Tensor, "b d h2 w2"]]:
        """Change a batch and resize it to ``size``.

        Args:
            image: RGB in [0, 1].
            unit_depth: depth / max_depth_m, not clipped, 0 where unmeasured: the ground truth, then a teacher's depth.
            aspect: width over height of the scene.
            draws: of :meth:`draw`.
        """
        draw = _Draw(draws["numbers"])
        image, unit_depth = cut_border(image, unit_depth, self.border)
        if self._moves:
            geometry = self._draw_geometry(draw)
            image, unit_depth = warp(image, unit_depth, geometry, size=size, aspect=aspect, least_zoom=self.zoom[0])
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
            image = (draws["noise"] * sigma).add_(image).clamp_(0, 1)
        if self.cut_depth:
            image = cut_depth(image, unit_depth[:, :1].clamp(max=1), self._draw_box(draw))
        return image, unit_depth

    def _blur(self, image: Tensor, sigma: Tensor) -> Tensor:
        """Blur images with a positive sigma, which is half of them."""
        if image.device.type != "cpu":  # selecting them would wait for the GPU
            return blur(image, sigma.clamp_min(0), largest=self.blur)
        rows = (sigma > 0).nonzero()[:, 0]
        return image.index_copy(0, rows, blur(image[rows], sigma[rows], largest=self.blur)) if len(rows) else image

    def _draw_geometry(self, draw: _Draw) -> Geometry:
        zoom = torch.where(draw.chance(self.zoom_chance), draw.log_uniform(*self.zoom), 1.0)
        room = 1 - 1 / zoom
        angle = math.radians(self.rotate_deg)
        centre = torch.stack([room * draw.uniform(-1, 1), room * draw.uniform(-1, 1)], dim=1)
        return Geometry(zoom, centre, angle=draw.uniform(-angle, angle), flip=draw.chance(self.flip))

    def _draw_box(self, draw: _Draw) -> Tensor:
        shown = draw.chance(self.cut_depth)
        left, top = draw.uniform(0, 1), draw.uniform(0, 1)
        wide, high = (self.cut_depth_size * draw.uniform(0, 1) * shown for _ in range(2))
        return torch.stack([left, top, left + (1 - left) * wide, top + (1 - top) * high], dim=1)


class _Draw:
    """Random numbers, one per image, handed out in the order in which they are used."""

    def __init__(self, numbers: Tensor) -> None:
        self._rows = iter(numbers)

    def uniform(self, low: float, high: float) -> Tensor:
        numbers: Tensor = next(self._rows)
        return numbers * (high - low) + low

    def log_uniform(self, low: float, high: float) -> Tensor:
        return self.uniform(math.log(low), math.log(high)).exp()

    def chance(self, probability: float) -> Tensor:
        return self.uniform(0, 1) < probability
