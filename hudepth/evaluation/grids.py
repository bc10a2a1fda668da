"""Predictions on pixel grids: what several protocols have in common is computed once.

Error maps and SSIM maps are computed once for the whole image; each protocol sums them over its own crop and mask.
Only alignment, and clamping that changes something, need maps of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hudepth.base.masked import widen, widest_float
from hudepth.metrics.alignment import align
from hudepth.metrics.depth import SUM_NAMES, DepthMaps, depth_maps
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.scale import SCALE_NAMES, scale_errors
from hudepth.metrics.ssim import ssim_map, whole_windows

T = TypeVar("T")

IMAGE_COLUMNS = (*SCALE_NAMES, "ssim")
"""What is known of an image as a whole."""
SUM_COLUMNS = (*SUM_NAMES, *IMAGE_COLUMNS)
"""Columns of a row of sums: those of :func:`hudepth.metrics.depth.depth_sums`, then those of the image."""


class Cache:
    """Computes a value once per key."""

    def __init__(self) -> None:
        self._known: dict[object, object] = {}

    def get(self, key: object, make: Callable[[], T]) -> T:
        """Return the value of ``key``, computed by ``make`` the first time."""
        if key not in self._known:
            self._known[key] = make()
        return self._known[key]  # type: ignore[return-value]


class Grid:
    """Ground truth of images of one size, shared by all predictors; ``depth_m`` is ignored where not ``measured``."""

    def __init__(self, depth_m: Float[Tensor, "b 1 h w"], measured: Bool[Tensor, "b 1 h w"]) -> None:
        self.depth_m, self.measured = depth_m, measured
        self._cache = Cache()

    def counts(self, protocol: Protocol) -> Bool[Tensor, "b 1 h w"]:
        """Return which pixels the protocol counts, before its crop; ``measured`` itself if that is all of them."""

        def compute() -> Tensor:
            within = protocol.within_caps(self.depth_m)
            return self.measured if bool((within | ~self.measured).all()) else self.measured & within

        return self._cache.get(protocol.caps, compute)

    def windows(self, protocol: Protocol) -> Bool[Tensor, "b 1 rows columns"]:
        """Return which SSIM windows hold only pixels that count."""
        counts = self.counts(protocol)
        key = (protocol.ssim_window, None if counts is self.measured else protocol.caps)
        return self._cache.get(key, lambda: whole_windows(counts, protocol.ssim_window))


class Scored:
    """A prediction [m] on a grid, shared by all protocols that resize it in the same way.

    ``inverse``: it is inverse depth, for protocols that align it.
    """

    def __init__(self, pred_m: Float[Tensor, "b 1 h w"], grid: Grid, *, inverse: bool = False) -> None:
        self.pred_m, self.grid, self._inverse = pred_m, grid, inverse
        self._cache = Cache()

    def prediction(self, protocol: Protocol) -> Float[Tensor, "b 1 h w"]:
        """Return the prediction as the protocol scores it: aligned, then clamped."""
        return self._cache.get(("prediction", *self._variant(protocol)), lambda: self._prediction(protocol))

    def sums(self, protocol: Protocol) -> Float[Tensor, "b k"]:
        """Return a row of :data:`SUM_COLUMNS` per image; where the crop leaves nothing, it counts 0 pixels."""
        height, width = self.grid.depth_m.shape[-2:]
        window = protocol.window(height, width)
        if window is None:
            row = torch.zeros(
                len(self.pred_m), len(SUM_COLUMNS), dtype=widest_float(self.pred_m.device), device=self.pred_m.device
            )
            row[:, -len(IMAGE_COLUMNS) :] = torch.nan
            return row
        rows, columns = window
        counts = self.grid.counts(protocol)
        sums = self._maps(protocol).sums(counts, masked=counts is self.grid.measured, rows=rows, columns=columns)
        pred_m, truth_m = (x[..., rows, columns] for x in (self.prediction(protocol), self.grid.depth_m))
        scale = scale_errors(pred_m, truth_m, counts[..., rows, columns])
        return torch.stack([*sums.values(), *scale.T, self._ssim(protocol, rows, columns)], dim=1)

    def _variant(self, protocol: Protocol) -> tuple[object, ...]:
        """Return the key of the aligned and clamped prediction; protocols with equal keys share it."""
        limits = protocol.caps[1:]
        if protocol.alignment != "none":
            seen = (tuple(key or ()) for key in (protocol.crop, protocol.crop_size, protocol.crop_shares))
            return (protocol.alignment, *seen, protocol.caps), limits if protocol.clamp else None
        if not protocol.clamp:
            return None, None
        least, most = self._cache.get("range", lambda: [x.item() for x in self.pred_m.aminmax()])
        inside = limits[0] <= least and (limits[1] is None or most <= limits[1])
        return None, None if inside else limits

    def _prediction(self, protocol: Protocol) -> Tensor:
        pred_m = self.pred_m
        if protocol.alignment != "none":
            counts = torch.zeros_like(self.grid.measured)
            rows, columns = protocol.window(*counts.shape[-2:]) or (slice(0), slice(0))
            counts[..., rows, columns] = self.grid.counts(protocol)[..., rows, columns]
            pred_m = align(pred_m, self.grid.depth_m, counts, kind=protocol.alignment, inverse=self._inverse)
        return pred_m.clamp(protocol.min_depth_m, protocol.max_depth_m) if protocol.clamp else pred_m

    def _maps(self, protocol: Protocol) -> DepthMaps:
        pred_m, key = self.prediction(protocol), ("maps", *self._variant(protocol))
        return self._cache.get(key, lambda: depth_maps(pred_m, self.grid.depth_m, self.grid.measured))

    def _ssim(self, protocol: Protocol, rows: slice, columns: slice) -> Float[Tensor, " b"]:
        size, measured = protocol.ssim_window, self.grid.measured
        height, width = measured[..., rows, columns].shape[-2:]
        if min(height, width) < size:
            return torch.full((len(measured),), torch.nan, dtype=widest_float(measured.device), device=measured.device)
        # the windows inside the crop are windows of the whole image
        top, left = rows.start, columns.start
        inside = slice(top, top + height - size + 1), slice(left, left + width - size + 1)
        whole = self.grid.windows(protocol)[..., *inside]

        def compute() -> Tensor:
            both = [torch.where(measured, depth_m, 0.0) for depth_m in (self.prediction(protocol), self.grid.depth_m)]
            return ssim_map(*both, data_range=protocol.ssim_data_range_m, window=size)

        key = ("ssim", size, protocol.ssim_data_range_m, *self._variant(protocol))
        values = self._cache.get(key, compute)[..., *inside]
        total = widen(torch.where(whole, values, 0.0).sum(dim=(1, 2, 3)))
        return total / whole.sum(dim=(1, 2, 3))
