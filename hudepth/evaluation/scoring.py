"""Scores of a batch under protocols, and their table with one row per image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from hudepth.base.errors import ConfigError
from hudepth.base.masked import widen
from hudepth.base.types import Batch
from hudepth.data.sources.base import Record
from hudepth.evaluation.grids import SUM_COLUMNS, Cache, Grid, Scored
from hudepth.metrics.boundary import BOUNDARY_NAMES, boundary_metrics
from hudepth.metrics.catalogue import registered_functions
from hudepth.metrics.depth import depth_metrics_from_sums
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.strata import strata_sums
from hudepth.metrics.summary import LOG_BIAS, ImageTable


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
    """Predictions of a batch [m] at network resolution, for scoring under any number of protocols.

    Other predictions may share the ground truth.
    """

    def __init__(self, pred_m: Float[Tensor, "b 1 h w"], truth: BatchTruth) -> None:
        self._pred_m, self._truth = pred_m, truth
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
        key = protocol.resize if protocol.needs_native else None
        return self._cache.get(key, lambda: self._on_grids(protocol))

    def _on_grids(self, protocol: Protocol) -> list[Scored]:
        grids = self._truth.grids(protocol)
        if not protocol.needs_native:
            return [Scored(self._pred_m, grids[0])]
        how: dict[str, Any] = {"mode": _MODES[protocol.resize]}
        how["align_corners"] = None if protocol.resize == "nearest" else False
        return [
            Scored(functional.interpolate(pred[None], size=grid.depth_m.shape[-2:], **how), grid)
            for pred, grid in zip(self._pred_m, grids, strict=True)
        ]


_MODES = {"nearest": "nearest-exact", "bilinear": "bilinear", "bicubic": "bicubic"}


def image_table(
    protocol: Protocol,
    sums: Float[Tensor, "n k"],
    records: Sequence[Record],
    *,
    boundary: Float[Tensor, "n e"] | None = None,
) -> ImageTable:
    """Turn rows of :meth:`BatchScores.sums` and :meth:`BatchScores.boundary` into the metrics of each image."""
    columns = dict(zip((*SUM_COLUMNS, *registered_functions()), sums.T, strict=True))
    others = {name: columns.pop(name) for name in ("ssim", *registered_functions())}
    values = depth_metrics_from_sums(columns, silog_lambda=protocol.silog_lambda, silog_factor=protocol.silog_factor)
    values |= {LOG_BIAS: columns["log"] / columns["count"], **others}
    if boundary is not None:
        values |= dict(zip(BOUNDARY_NAMES, boundary.T, strict=True))
    return ImageTable(
        ids=[record.id for record in records],
        scenes=[record.scene for record in records],
        categories=[record.category for record in records],
        pixels=columns["count"].long().numpy(),
        values={name: column.double().numpy() for name, column in values.items()},
    )
