"""Scoring predictions under protocols: what several have in common is computed once.

A :class:`Grid` is the truth of some images on one pixel grid, shared by all predictors; a :class:`Scored` is one
prediction on it, shared by all protocols that resize it in the same way. Error maps and SSIM maps are made once for
the whole image; a protocol then sums them over its own crop and mask. Only alignment, and clamping that changes
something, need maps of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.nn import functional

from hudepth.base.errors import ConfigError
from hudepth.base.types import Batch
from hudepth.data.sources.base import Record
from hudepth.metrics.alignment import align
from hudepth.metrics.boundary import BOUNDARY_NAMES, boundary_metrics
from hudepth.metrics.depth import SUM_NAMES, DepthMaps, depth_maps, depth_metrics_from_sums
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.ssim import ssim_map, whole_windows
from hudepth.metrics.strata import strata_sums
from hudepth.metrics.summary import LOG_BIAS, ImageTable

T = TypeVar("T")

SUM_COLUMNS = (*SUM_NAMES, "ssim")
"""Columns of a row of sums: those of :func:`hudepth.metrics.depth.depth_sums`, then the image's ssim."""


class _Cache:
    """Remembers what was computed for a key."""

    def __init__(self) -> None:
        self._known: dict[object, object] = {}

    def get(self, key: object, make: Callable[[], T]) -> T:
        if key not in self._known:
            self._known[key] = make()
        return self._known[key]  # type: ignore[return-value]


class Grid:
    """The truth of some images of one size, and what follows from it alone.

    Args:
        depth_m: ground-truth depth [m], ignored where not measured.
        measured: where there is truth.
    """

    def __init__(self, depth_m: Float[Tensor, "b 1 h w"], measured: Bool[Tensor, "b 1 h w"]) -> None:
        self.depth_m, self.measured = depth_m, measured
        self._cache = _Cache()

    def counts(self, protocol: Protocol) -> Bool[Tensor, "b 1 h w"]:
        """Return which pixels count in this protocol, its crop aside; ``measured`` itself if that is all of them."""
        return self._cache.get(protocol.caps, lambda: self._counts(protocol))

    def _counts(self, protocol: Protocol) -> Tensor:
        within = protocol.within_caps(self.depth_m)
        return self.measured if bool((within | ~self.measured).all()) else self.measured & within

    def windows(self, protocol: Protocol) -> Bool[Tensor, "b 1 rows columns"]:
        """Return which windows of SSIM hold only pixels that count."""
        counts = self.counts(protocol)
        key = (protocol.ssim_window, None if counts is self.measured else protocol.caps)
        return self._cache.get(key, lambda: whole_windows(counts, protocol.ssim_window))


class Scored:
    """A prediction on a grid, to be scored under any number of protocols.

    Args:
        pred_m: predicted depth at the grid's size [m].
        grid: the truth.
    """

    def __init__(self, pred_m: Float[Tensor, "b 1 h w"], grid: Grid) -> None:
        self.pred_m, self.grid = pred_m, grid
        self._cache = _Cache()

    def prediction(self, protocol: Protocol) -> Float[Tensor, "b 1 h w"]:
        """Return the prediction as the protocol wants it: aligned, then clamped."""
        return self._cache.get(("prediction", *self._variant(protocol)), lambda: self._prediction(protocol))

    def sums(self, protocol: Protocol) -> Float64[Tensor, "b k"]:
        """Return a row of sums for each image, columns as in :data:`SUM_COLUMNS`.

        An image that the crop exceeds, or of which it leaves nothing, counts 0 pixels.
        """
        height, width = self.grid.depth_m.shape[-2:]
        window = protocol.window(height, width)
        if window is None:
            row = torch.zeros(len(self.pred_m), len(SUM_COLUMNS), dtype=torch.float64, device=self.pred_m.device)
            row[:, -1] = torch.nan
            return row
        rows, columns = window
        counts = self.grid.counts(protocol)
        sums = self._maps(protocol).sums(counts, masked=counts is self.grid.measured, rows=rows, columns=columns)
        return torch.stack([*sums.values(), self._ssim(protocol, rows, columns)], dim=1)

    def _variant(self, protocol: Protocol) -> tuple[object, ...]:
        """Name the prediction that protocols share: those that align or change nothing by clamping get the same."""
        limits = protocol.caps[1:]
        if protocol.alignment != "none":
            seen = (tuple(key or ()) for key in (protocol.crop, protocol.crop_size))
            return (protocol.alignment, *seen, protocol.caps), limits if protocol.clamp else None
        clamps = protocol.clamp and not self._cache.get(("inside", limits), lambda: self._inside(protocol))
        return None, limits if clamps else None

    def _inside(self, protocol: Protocol) -> bool:
        low, high = protocol.min_depth_m, protocol.max_depth_m
        least, most = (x.item() for x in self.pred_m.aminmax())
        return low <= least and (high is None or most <= high)

    def _prediction(self, protocol: Protocol) -> Tensor:
        pred_m = self.pred_m
        if protocol.alignment != "none":
            counts = torch.zeros_like(self.grid.measured)
            rows, columns = protocol.window(*counts.shape[-2:]) or (slice(0), slice(0))
            counts[..., rows, columns] = self.grid.counts(protocol)[..., rows, columns]
            pred_m = align(pred_m, self.grid.depth_m, counts, kind=protocol.alignment)
        return pred_m.clamp(protocol.min_depth_m, protocol.max_depth_m) if protocol.clamp else pred_m

    def _maps(self, protocol: Protocol) -> DepthMaps:
        pred_m = self.prediction(protocol)
        return self._cache.get(
            ("maps", *self._variant(protocol)), lambda: depth_maps(pred_m, self.grid.depth_m, self.grid.measured)
        )

    def _ssim(self, protocol: Protocol, rows: slice, columns: slice) -> Float64[Tensor, " b"]:
        size, measured = protocol.ssim_window, self.grid.measured
        height, width = measured[..., rows, columns].shape[-2:]
        if min(height, width) < size:
            return torch.full((len(measured),), torch.nan, dtype=torch.float64, device=measured.device)
        # the windows inside the crop are windows of the whole image
        inside = (
            slice(rows.start, rows.start + height - size + 1),
            slice(columns.start, columns.start + width - size + 1),
        )
        whole = self.grid.windows(protocol)[..., *inside]
        values = self._cache.get(
            ("ssim", size, protocol.ssim_data_range_m, *self._variant(protocol)), lambda: self._ssim_map(protocol)
        )[..., *inside]
        total = torch.where(whole, values, 0.0).sum(dim=(1, 2, 3)).double()
        return total / whole.sum(dim=(1, 2, 3))

    def _ssim_map(self, protocol: Protocol) -> Tensor:
        pred_m, truth_m = (
            torch.where(self.grid.measured, x, 0.0) for x in (self.prediction(protocol), self.grid.depth_m)
        )
        return ssim_map(pred_m, truth_m, data_range=protocol.ssim_data_range_m, window=protocol.ssim_window)


class BatchTruth:
    """The truth of a batch, on the grids that protocols ask for.

    Args:
        batch: holds the truth.
        max_depth_m: what unit depth 1 stands for in the batch.
    """

    def __init__(self, batch: Batch, *, max_depth_m: float) -> None:
        self._batch, self._max_depth_m = batch, max_depth_m
        self._cache = _Cache()

    def grids(self, protocol: Protocol) -> list[Grid]:
        """Return one grid at network resolution, or one for each image at its native resolution.

        Raises:
            ConfigError: if the protocol needs native truth and the batch has none.
        """
        return self._cache.get(protocol.needs_native, lambda: self._grids(protocol))

    def _grids(self, protocol: Protocol) -> list[Grid]:
        batch = self._batch
        if not protocol.needs_native:
            return [Grid(batch["unit_depth"] * self._max_depth_m, batch["valid"])]
        if "native_depth" not in batch:
            raise ConfigError(
                f"protocol={protocol.name} scores at native resolution, which this store was prepared without. "
                "Pass data.native=true, or protocol=paper."
            )
        return [Grid(truth[None].to(batch["image"].device), truth[None] > 0) for truth in batch["native_depth"]]


class BatchScores:
    """The predictions of a batch, to be scored under any number of protocols.

    Args:
        pred_m: predicted depth at network resolution [m].
        truth: of the same batch, perhaps shared with other predictions.
    """

    def __init__(self, pred_m: Float[Tensor, "b 1 h w"], truth: BatchTruth) -> None:
        self._pred_m, self._truth = pred_m, truth
        self._cache = _Cache()

    def sums(self, protocol: Protocol) -> Float64[Tensor, "b k"]:
        """Return a row of sums for each image, columns as in :data:`SUM_COLUMNS`."""
        return torch.cat([scored.sums(protocol) for scored in self._scored(protocol)])

    def boundary(self, protocol: Protocol) -> Float64[Tensor, "b k"]:
        """Return the boundary metrics of each image, columns as in :data:`hudepth.metrics.boundary.BOUNDARY_NAMES`."""
        rows = [torch.stack([*boundary_metrics(*x).values()], dim=1) for x in self._cropped(protocol)]
        return torch.cat(rows)

    def strata(self, protocol: Protocol) -> Float64[Tensor, "b bins k"]:
        """Return the sums of each image over the bins of :data:`hudepth.metrics.strata.STRATA`."""
        return torch.cat([strata_sums(*x) for x in self._cropped(protocol)])

    def _cropped(self, protocol: Protocol) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        for scored in self._scored(protocol):
            pred_m, truth_m, counts = scored.prediction(protocol), scored.grid.depth_m, scored.grid.counts(protocol)
            window = protocol.window(*truth_m.shape[-2:])
            if window is None:
                yield pred_m, truth_m, torch.zeros_like(counts)
            else:
                yield pred_m[..., *window], truth_m[..., *window], counts[..., *window]

    def _scored(self, protocol: Protocol) -> list[Scored]:
        key = protocol.resize if protocol.needs_native else None
        return self._cache.get(key, lambda: self._on_grids(protocol))

    def _on_grids(self, protocol: Protocol) -> list[Scored]:
        grids = self._truth.grids(protocol)
        if not protocol.needs_native:
            return [Scored(self._pred_m, grids[0])]
        corners = None if protocol.resize == "nearest" else False
        return [
            Scored(
                functional.interpolate(
                    pred[None], size=grid.depth_m.shape[-2:], mode=_MODES[protocol.resize], align_corners=corners
                ),
                grid,
            )
            for pred, grid in zip(self._pred_m, grids, strict=True)
        ]


_MODES = {"nearest": "nearest-exact", "bilinear": "bilinear", "bicubic": "bicubic"}


def image_table(
    protocol: Protocol,
    sums: Float64[Tensor, "n k"],
    records: Sequence[Record],
    *,
    boundary: Float64[Tensor, "n e"] | None = None,
) -> ImageTable:
    """Turn rows of sums into the metrics of each image.

    Args:
        protocol: whose silog is meant.
        sums: rows of :meth:`BatchScores.sums`.
        records: which pair each row is of.
        boundary: rows of :meth:`BatchScores.boundary`.
    """
    columns = dict(zip(SUM_COLUMNS, sums.T, strict=True))
    ssim = columns.pop("ssim")
    values = depth_metrics_from_sums(columns, silog_lambda=protocol.silog_lambda, silog_factor=protocol.silog_factor)
    values |= {LOG_BIAS: columns["log"] / columns["count"], "ssim": ssim}
    if boundary is not None:
        values |= dict(zip(BOUNDARY_NAMES, boundary.T, strict=True))
    return ImageTable(
        ids=[record.id for record in records],
        scenes=[record.scene for record in records],
        categories=[record.category for record in records],
        pixels=columns["count"].long().numpy(),
        values={name: column.double().numpy() for name, column in values.items()},
    )
