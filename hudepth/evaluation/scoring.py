"""Scores of a batch under protocols, and their table with one row per image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from hudepth.base.errors import ConfigError
from hudepth.base.masked import widen
from hudepth.base.types import Batch
from hudepth.data.sources.base import Record
from hudepth.evaluation.grids import IMAGE_COLUMNS, SUM_COLUMNS, Cache, Grid, Scored
from hudepth.metrics.boundary import BOUNDARY_NAMES, boundary_metrics
from hudepth.metrics.catalogue import registered_functions
from hudepth.metrics.depth import depth_metrics_from_sums
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.strata import strata_sums
from hudepth.metrics.summary import LOG_BIAS, ImageTable
from hudepth.metrics.uncertainty import UNCERTAINTY_NAMES, uncertainty_metrics


class BatchTruth:
    """Ground truth of a batch, which holds depth / max_depth_m, on the grids that protocols need."""

    def __init__(self, batch: Batch, *, max_depth_m: float) -> None:
        self._batch, self._max_depth_m = batch, max_depth_m
        self._cache = Cache()

    def grids(self, protocol: Protocol) -> list[Grid]:
        """Return one grid at network resolution, or one for each image at its native resolution.

        Raises ConfigError if the protocol needs native ground truth and the batch has none.
        """
        batch = self._batch
        if not protocol.needs_native:
            return self._cache.get(False, lambda: [Grid(batch["unit_depth"] * self._max_depth_m, batch["valid"])])
        if "native_depth" not in batch:
            why = "scores at native resolution, which this store was prepared without"
            raise ConfigError(f"protocol={protocol.name} {why}. Pass data.native=true, or protocol=paper.")
        device, truths = batch["image"].device, batch["native_depth"]
        return self._cache.get(True, lambda: [Grid(truth[None].to(device), truth[None] > 0) for truth in truths])


class BatchScores:
    """Predictions of a batch [m], for scoring under any number of protocols: at network resolution, or each at its own.

    ``inverse``: they are inverse depths, for protocols that align them. Other predictions may share the ground truth.
    """

    def __init__(
        self, pred_m: Float[Tensor, "b 1 h w"] | Sequence[Tensor], truth: BatchTruth, *, inverse: bool = False
    ) -> None:
        self._pred_m, self._truth, self._inverse = pred_m, truth, inverse
        self._cache = Cache()

    def sums(self, protocol: Protocol) -> Float[Tensor, "b k"]:
        """Return a row of sums for each image: columns as in :data:`SUM_COLUMNS`, then registered metrics."""
        columns = [torch.cat([scored.sums(protocol) for scored in self._scored(protocol)])]
        functions = registered_functions().values()
        images = [*self._cropped(protocol)] if functions else []
        for function in functions:
            values = [torch.where(x[2].any(dim=(1, 2, 3)), widen(function(*x)), torch.nan) for x in images]
            columns.append(torch.cat(values)[:, None])
        return torch.cat(columns, dim=1)

    def boundary(self, protocol: Protocol) -> Float[Tensor, "b k"]:
        """Return the boundary metrics of each image, columns as in :data:`hudepth.metrics.boundary.BOUNDARY_NAMES`."""
        return torch.cat([torch.stack([*boundary_metrics(*x).values()], dim=1) for x in self._cropped(protocol)])

    def uncertainty(self, protocol: Protocol, spread: BatchScores) -> Float[Tensor, "b k"]:
        """Return columns of :data:`hudepth.metrics.uncertainty.UNCERTAINTY_NAMES`; ``spread`` holds uncertainties."""
        rows = []
        for (pred_m, truth_m, counts), unsure in zip(self._cropped(protocol), spread._scored(protocol), strict=True):
            window = protocol.window(*unsure.pred_m.shape[-2:]) or (slice(None), slice(None))
            rows.append(uncertainty_metrics(pred_m, truth_m, counts, unsure.pred_m[..., *window]))
        return torch.cat(rows)

    def strata(self, protocol: Protocol) -> Float[Tensor, "b bins k"]:
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
        fits = isinstance(self._pred_m, Tensor) and not protocol.needs_native
        key = protocol.needs_native, None if fits else protocol.resize
        return self._cache.get(key, lambda: self._on_grids(protocol))

    def _on_grids(self, protocol: Protocol) -> list[Scored]:
        grids, predictions = self._truth.grids(protocol), self._pred_m
        if protocol.needs_native:
            pairs = zip(predictions, grids, strict=True)
            resized = [_resize(pred[None], grid.depth_m.shape[-2:], protocol) for pred, grid in pairs]
        elif isinstance(predictions, Tensor):
            resized = [predictions]
        else:
            size = grids[0].depth_m.shape[-2:]
            resized = [torch.cat([_resize(pred[None], size, protocol) for pred in predictions])]
        return [Scored(pred, grid, inverse=self._inverse) for pred, grid in zip(resized, grids, strict=True)]


def _resize(pred: Float[Tensor, "1 1 h w"], size: torch.Size, protocol: Protocol) -> Float[Tensor, "1 1 h2 w2"]:
    corners = None if protocol.resize == "nearest" else False
    return functional.interpolate(pred, size=size, mode=_MODES[protocol.resize], align_corners=corners)


_MODES = {"nearest": "nearest-exact", "bilinear": "bilinear", "bicubic": "bicubic"}


def image_table(
    protocol: Protocol,
    sums: Float[Tensor, "n k"],
    records: Sequence[Record],
    *,
    boundary: Float[Tensor, "n e"] | None = None,
    uncertainty: Float[Tensor, "n u"] | None = None,
) -> ImageTable:
    """Turn rows of the methods of :class:`BatchScores` into the metrics of each image."""
    columns = dict(zip((*SUM_COLUMNS, *registered_functions()), sums.T, strict=True))
    others = {name: columns.pop(name) for name in (*IMAGE_COLUMNS, *registered_functions())}
    values = depth_metrics_from_sums(columns, silog_lambda=protocol.silog_lambda, silog_factor=protocol.silog_factor)
    values |= {LOG_BIAS: columns["log"] / columns["count"], **others}
    if boundary is not None:
        values |= dict(zip(BOUNDARY_NAMES, boundary.T, strict=True))
    if uncertainty is not None:
        values |= dict(zip(UNCERTAINTY_NAMES, uncertainty.T, strict=True))
    return ImageTable(
        ids=[record.id for record in records],
        scenes=[record.scene for record in records],
        categories=[record.category for record in records],
        pixels=columns["count"].long().numpy(),
        values={name: column.double().numpy() for name, column in values.items()},
    )
