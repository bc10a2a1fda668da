"""Trivial baselines that any model must beat, computed from the training subset alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from hudepth.base.console import track
from hudepth.base.normalise import normalise_image
from hudepth.data.store import DepthStore

DESCRIPTOR_SIZE = (10, 10)
"""Rows and columns of the thumbnail that :class:`NearestFrame` compares images by."""
_CHUNK = 64


class Baseline(nn.Module):
    """A predictor without a network; test-time flips do not apply to it."""


class ConstantDepth(Baseline):
    """Predicts the same unit depth map for every image."""

    unit_depth: Tensor

    def __init__(self, unit_depth: Float[Tensor, "1 1 h w"]) -> None:
        super().__init__()
        self.register_buffer("unit_depth", unit_depth)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return the map once per image."""
        return self.unit_depth.expand(len(image), -1, -1, -1)


class NearestFrame(Baseline):
    """Copies the depth of the most similar training image, ``fill`` where that is unmeasured.

    Where it comes close to a network, test images have near duplicates in the training subset. ``train`` holds the
    positions of the training pairs in the store, ``descriptors`` what :func:`descriptor` makes of their images.
    """

    descriptors: Tensor
    fill: Tensor

    def __init__(
        self,
        store: DepthStore,
        train: Sequence[int],
        *,
        descriptors: Float[Tensor, "n d"],
        fill: Float[Tensor, "1 1 h w"],
        max_depth_m: float,
    ) -> None:
        super().__init__()
        self.register_buffer("descriptors", descriptors)
        self.register_buffer("fill", fill)
        self._store, self._train, self._max_depth_m = store, list(train), max_depth_m

    def nearest(self, image: Float[Tensor, "b 3 h w"]) -> list[int]:
        """Return the store positions of the training images most similar to normalised images."""
        query = descriptor(image)
        # |a - b|^2 - |a|^2: the same b is nearest
        distance = self.descriptors.square().sum(dim=1) - 2 * query @ self.descriptors.T
        return [self._train[i] for i in distance.argmin(dim=1).tolist()]

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return the depth of the nearest training image of each image."""
        _, stored_depth = self._store.read(self.nearest(image))
        unit = _unit_depth(stored_depth, self._store.per_m * self._max_depth_m).float()[:, None].to(image.device)
        return torch.where(unit > 0, unit, self.fill)


def descriptor(image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
    """Return thumbnails of normalised images, averaged over areas."""
    return functional.adaptive_avg_pool2d(image.float(), DESCRIPTOR_SIZE).flatten(1)


def trivial_baselines(store: DepthStore, train: Sequence[int], *, max_depth_m: float) -> dict[str, Baseline]:
    """Compute the baselines in one pass over the training pairs, whose positions in the store are ``train``.

    ``nearest_frame`` is the depth of the most similar training image, ``mean_depth_map`` each pixel's mean over the
    training set, ``mean_depth`` one mean for all pixels. Depth is clipped to ``max_depth_m`` and divided by it.
    """
    total = torch.zeros(store.size, dtype=torch.float64)
    count = torch.zeros(store.size, dtype=torch.float64)
    described = []
    starts = range(0, len(train), _CHUNK)
    for start in track(starts, total=len(starts), what="trivial baselines"):
        images, stored_depth = store.read(train[start : start + _CHUNK])
        # pooling first gives the same result faster
        small = functional.adaptive_avg_pool2d(torch.from_numpy(images).permute(0, 3, 1, 2).float(), DESCRIPTOR_SIZE)
        described.append(normalise_image(small / 255).flatten(1))
        unit = _unit_depth(stored_depth, store.per_m * max_depth_m)
        total += unit.sum(dim=0)
        count += (unit > 0).sum(dim=0)
    mean = total.sum() / count.sum()
    mean_map = torch.where(count > 0, total / count.clamp(min=1), mean).float()[None, None]
    descriptors = torch.cat(described)
    return {
        "nearest_frame": NearestFrame(store, train, descriptors=descriptors, fill=mean_map, max_depth_m=max_depth_m),
        "mean_depth_map": ConstantDepth(mean_map),
        "mean_depth": ConstantDepth(mean.expand(store.size).float()[None, None]),
    }


def _unit_depth(stored: np.ndarray, largest: float) -> Float[Tensor, "n h w"]:
    return (torch.from_numpy(stored).double() / largest).clamp_(max=1)
