"""A graph that takes images of any size and returns depth at their size: resizing is part of it."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional


class AnySize(nn.Module):
    """A pipeline (RGB bytes at ``size`` to metres) for images of any size, as hudepth-predict resizes with fit=stretch.

    Images are averaged over areas if both sides shrink, else interpolated bilinearly, and rounded to bytes; depth is
    interpolated bilinearly. Either is a product with a matrix of weights for each axis, which exporters can express for
    sides that are not known yet.
    """

    def __init__(self, pipeline: nn.Module, size: tuple[int, int]) -> None:
        super().__init__()
        self.pipeline, self.size = pipeline, size

    def forward(self, image: UInt8[Tensor, "b H W 3"]) -> Float[Tensor, "b H W"]:
        """Predict depth [m]."""
        height, width = image.shape[1:3]
        rows, columns = (torch.arange(side, device=image.device) for side in (height, width))
        shrinks = (rows[-1] + 1 >= self.size[0]) & (columns[-1] + 1 >= self.size[1])
        down, across = (
            torch.where(shrinks, area_weights(cells, side), linear_weights(cells, side))
            for cells, side in zip((rows, columns), self.size, strict=True)
        )
        high = (down @ image.float().flatten(2)).reshape(-1, self.size[0], width, 3)
        small = (high.transpose(2, 3) @ across.T).transpose(2, 3)
        halves = (rows[-1] + 1 == 2 * self.size[0]) & (columns[-1] + 1 == 2 * self.size[1])
        rounded = (small + 0.1 * halves).round()  # to even, but for the mean of four pixels OpenCV rounds up
        depth: Tensor = self.pipeline(rounded.clamp(0, 255).to(torch.uint8))
        return functional.interpolate(depth[:, None], (height, width), mode="bilinear", align_corners=False)[:, 0]


def area_weights(cells: Tensor, count: int) -> Float[Tensor, "n N"]:
    """Return the share of each of N pixels, numbered by ``cells`` from 0, in ``count`` pixels that cover as much."""
    ratio = (cells[-1] + 1).float() / count
    starts = torch.arange(count, device=cells.device)[:, None] * ratio
    overlap = torch.minimum(starts + ratio, cells + 1) - torch.maximum(starts, cells.float())
    return overlap.clamp(min=0) / ratio


def linear_weights(cells: Tensor, count: int) -> Float[Tensor, "n N"]:
    """Return the weights of N pixels, numbered by ``cells`` from 0, in a linear interpolation to ``count`` pixels."""
    ratio = (cells[-1] + 1).float() / count
    centres = ((torch.arange(count, device=cells.device) + 0.5) * ratio - 0.5)[:, None]
    return (1 - (torch.minimum(centres.clamp(min=0), cells[-1]) - cells).abs()).clamp(min=0)
