"""Depth metrics and SSIM as torchmetrics, accumulated over batches and processes.

Their states are float64 sums and counts: a result depends neither on the batch size nor on the number of
processes.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics import Metric

from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.metrics.depth import METRIC_NAMES, SUM_NAMES, depth_metrics_from_sums, depth_sums
from hudepth.metrics.ssim import ssim_sums

AVERAGINGS = ("image", "pooled")
"""Values of ``averaging``, the default first."""


class DepthMetrics(Metric):
    """All metrics of :mod:`hudepth.metrics.depth`, as a dictionary.

    Args:
        averaging: "image": metrics of each image, then their mean (usual); "pooled": over all pixels at once.
        silog_lambda: share of the squared mean log error that is forgiven, in [0, 1].
        silog_factor: scale of silog.
        kwargs: as for :class:`torchmetrics.Metric`.

    Raises:
        ConfigError: if ``averaging`` is unknown or ``silog_lambda`` out of range.
    """

    full_state_update = False
    totals: Tensor
    images: Tensor

    def __init__(
        self,
        *,
        averaging: str = "image",
        silog_lambda: float = 1.0,
        silog_factor: float = 100.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if averaging not in AVERAGINGS:
            hint = did_you_mean(str(averaging), AVERAGINGS)
            raise ConfigError(f"metrics.averaging: no choice '{averaging}'. Use 'image' or 'pooled'.{hint}")
        if not 0 <= silog_lambda <= 1:
            raise ConfigError(f"metrics.silog_lambda: {silog_lambda} is not in [0, 1]. The usual values are 1 and 0.5.")
        self.averaging = averaging
        self.silog_lambda = silog_lambda
        self.silog_factor = silog_factor
        size = len(METRIC_NAMES if averaging == "image" else SUM_NAMES)
        self.add_state("totals", torch.zeros(size, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("images", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(
        self,
        pred_m: Float[Tensor, "b 1 h w"],
        target_m: Float[Tensor, "b 1 h w"],
        valid: Bool[Tensor, "b 1 h w"],
    ) -> None:
        """Add a batch. Images without a valid pixel are skipped.

        Args:
            pred_m: predicted depth [m].
            target_m: ground-truth depth [m], positive where valid.
            valid: True where the truth is measured.
        """
        sums = depth_sums(pred_m, target_m, valid)
        rows = sums if self.averaging == "pooled" else self._finish(sums)
        measured = sums["count"] > 0
        values = torch.where(measured, torch.stack(list(rows.values())), 0.0)
        # not in place: a state that a half-precision module has cast becomes float64 again
        self.totals = self.totals + values.sum(dim=1)
        self.images = self.images + measured.sum()

    def compute(self) -> dict[str, Tensor]:
        """Return each metric by name; NaN if no image had a valid pixel."""
        if self.averaging == "pooled":
            return self._finish(dict(zip(SUM_NAMES, self.totals, strict=True)))
        return dict(zip(METRIC_NAMES, self.totals / self.images, strict=True))

    def _finish(self, sums: dict[str, Tensor]) -> dict[str, Tensor]:
        return depth_metrics_from_sums(sums, silog_lambda=self.silog_lambda, silog_factor=self.silog_factor)


class DepthSSIM(Metric):
    """Mean over images of :func:`hudepth.metrics.ssim.ssim`, with its window of 11 x 11 and sigma 1.5.

    Args:
        data_range: the span of possible depths [m], normally ``max_depth_m``; positive.
        kwargs: as for :class:`torchmetrics.Metric`.

    Raises:
        ConfigError: if ``data_range`` is not positive.
    """

    full_state_update = False
    total: Tensor
    images: Tensor

    def __init__(self, *, data_range: float, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not (math.isfinite(data_range) and data_range > 0):
            raise ConfigError(f"metrics.data_range: {data_range} is not positive. Pass the maximum depth in metres.")
        self.data_range = data_range
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("images", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(
        self,
        pred_m: Float[Tensor, "b 1 h w"],
        target_m: Float[Tensor, "b 1 h w"],
        valid: Bool[Tensor, "b 1 h w"],
    ) -> None:
        """Add a batch. Images without a window of valid pixels are skipped.

        Args:
            pred_m: predicted depth [m].
            target_m: ground-truth depth [m]; ignored where not valid.
            valid: True where the truth is measured.

        Raises:
            ConfigError: if the images are smaller than the window.
        """
        total, windows = ssim_sums(pred_m, target_m, valid, data_range=self.data_range)
        measured = windows > 0
        self.total = self.total + torch.where(measured, total / windows, 0.0).sum()
        self.images = self.images + measured.sum()

    def compute(self) -> Tensor:
        """Return the mean; NaN if no image had a window of valid pixels."""
        return self.total / self.images
