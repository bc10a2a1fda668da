"""Metrics as torchmetrics, accumulated over batches and processes.

Their states are float64 sums and counts: a result depends neither on the batch size nor on the number of processes.
Metrics that follow from the same sums share their states in a :class:`torchmetrics.MetricCollection`.
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torchmetrics import Metric, MetricCollection

from hudepth.base.errors import ConfigError
from hudepth.base.masked import widen
from hudepth.base.options import Range, convert
from hudepth.base.types import DepthMap, Mask
from hudepth.metrics.catalogue import Function, metric_info, registered_functions
from hudepth.metrics.depth import METRIC_NAMES, SUM_NAMES, depth_metrics_from_sums, depth_sums
from hudepth.metrics.ssim import ssim_sums

Averaging = Literal["image", "pooled"]
"""``image``: the mean of the images' metrics (usual); ``pooled``: over all pixels at once."""


class SumMetric(Metric):
    """A metric whose states are float64 sums; on MPS, which has no float64, they are float32."""

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = ()) -> nn.Module:
        @functools.wraps(fn)  # torchmetrics goes by its name
        def apply(x: Tensor) -> Tensor:
            try:
                return fn(x)
            except TypeError:
                return fn(x.float())

        return super()._apply(apply, exclude_state)


class DepthMetrics(SumMetric):
    """All metrics of :mod:`hudepth.metrics.depth`, as a dictionary.

    Args:
        averaging: one of :data:`Averaging`.
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
        self, *, averaging: str = "image", silog_lambda: float = 1.0, silog_factor: float = 100.0, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.averaging = convert("metrics.averaging", averaging, Averaging, default="image")
        self.silog_lambda = convert("metrics.silog_lambda", silog_lambda, Annotated[float, Range(0, 1)], default=1.0)
        self.silog_factor = silog_factor
        size = len(METRIC_NAMES if averaging == "image" else SUM_NAMES)
        self.add_state("totals", torch.zeros(size, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("images", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, pred_m: DepthMap, target_m: DepthMap, valid: Mask) -> None:
        """Add a batch of depths [m], ``target_m`` positive where valid; images without a valid pixel are skipped."""
        sums = depth_sums(pred_m, target_m, valid)
        rows = sums if self.averaging == "pooled" else self._finish(sums)
        measured = sums["count"] > 0
        values = torch.where(measured, torch.stack(list(rows.values())), 0.0)
        # not in place: a state that a half-precision module has cast becomes float64 again
        self.totals = self.totals + values.sum(dim=1)
        self.images = self.images + measured.sum()

    def compute(self) -> Any:
        """Return each metric by name; NaN if no image had a valid pixel."""
        if self.averaging == "pooled":
            return self._finish(dict(zip(SUM_NAMES, self.totals, strict=True)))
        return dict(zip(METRIC_NAMES, self.totals / self.images, strict=True))

    def _finish(self, sums: dict[str, Tensor]) -> dict[str, Tensor]:
        return depth_metrics_from_sums(sums, silog_lambda=self.silog_lambda, silog_factor=self.silog_factor)


class DepthMetric(DepthMetrics):
    """One metric of :class:`DepthMetrics`, with its arguments; ``compute`` returns a scalar."""

    name: str

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.higher_is_better = metric_info(cls.name).higher_is_better

    def compute(self) -> Any:
        """Return the metric; NaN if no image had a valid pixel."""
        return super().compute()[self.name]


class AbsRel(DepthMetric):
    """Mean of ``|pred - target| / target``."""

    name = "abs_rel"


class SqRel(DepthMetric):
    """Mean of ``(pred - target)^2 / target`` [m]."""

    name = "sq_rel"


class MSE(DepthMetric):
    """Mean squared error [m^2]."""

    name = "mse"


class RMSE(DepthMetric):
    """Root of the mean squared error [m]."""

    name = "rmse"


class RMSELog(DepthMetric):
    """Root of the mean squared error of natural logarithms."""

    name = "rmse_log"


class Log10(DepthMetric):
    """Mean absolute error of decimal logarithms."""

    name = "log10"


class SILog(DepthMetric):
    """Scale-invariant error of logarithms."""

    name = "silog"


class MAE(DepthMetric):
    """Mean absolute error [m]."""

    name = "mae"


class Delta(DepthMetric):
    """Share of pixels with ``max(pred / target, target / pred) < 1.25^power``; ``power`` is 1, 2 or 3."""

    name = "delta1"

    def __init__(self, power: int = 1, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.name = f"delta{convert('power', power, Annotated[int, Range(1, 3)], default=1)}"


class ImageMetric(SumMetric, ABC):
    """The mean over images of a metric that may be undefined for some of them, which are skipped."""

    full_state_update = False
    total: Tensor
    images: Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("images", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    @abstractmethod
    def measure(
        self, pred_m: Tensor, target_m: Tensor, valid: Tensor
    ) -> tuple[Float[Tensor, " b"], Bool[Tensor, " b"]]:
        """Return the metric of each image, and which of them count."""

    def update(self, pred_m: DepthMap, target_m: DepthMap, valid: Mask) -> None:
        """Add a batch; arguments as in :meth:`DepthMetrics.update`."""
        values, counts = self.measure(pred_m, target_m, valid)
        self.total = self.total + torch.where(counts, values, 0.0).sum()
        self.images = self.images + counts.sum()

    def compute(self) -> Tensor:
        """Return the mean; NaN if no image counted."""
        return self.total / self.images


class DepthSSIM(ImageMetric):
    """Mean over images of :func:`hudepth.metrics.ssim.ssim`, with its window of 11 x 11 and sigma 1.5.

    ``data_range`` is the span of possible depths [m], normally ``max_depth_m``. Images without a window of valid pixels
    are skipped. Raises ConfigError if ``data_range`` is not positive or images are smaller than the window.
    """

    higher_is_better = True

    def __init__(self, *, data_range: float, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not (math.isfinite(data_range) and data_range > 0):
            raise ConfigError(f"metrics.data_range: {data_range} is not positive. Pass the maximum depth in metres.")
        self.data_range = data_range

    def measure(self, pred_m: Tensor, target_m: Tensor, valid: Tensor) -> tuple[Float[Tensor, " b"], Tensor]:
        """Return SSIM, and which images have a window of valid pixels."""
        total, windows = ssim_sums(pred_m, target_m, valid, data_range=self.data_range)
        return total / windows, windows > 0


class FunctionMetric(ImageMetric):
    """Mean over images of a function of (pred_m, target_m, valid) that returns [b], NaN where undefined."""

    def __init__(self, function: Function, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.function = function

    def measure(self, pred_m: Tensor, target_m: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Return the function's values, and where they are defined."""
        values = widen(self.function(pred_m, target_m, valid))
        return values, valid.flatten(1).any(dim=1) & ~values.isnan()


def validation_names() -> tuple[str, ...]:
    """Return the names of :func:`validation_metrics`."""
    return (*METRIC_NAMES, "ssim", *registered_functions())


def validation_metrics(*, max_depth_m: float, prefix: str) -> MetricCollection:
    """Return all metrics that validation computes: depth metrics, SSIM on unit depth, and registered ones."""
    own = {name: FunctionMetric(function) for name, function in registered_functions().items()}
    metrics: dict[str, Metric | MetricCollection] = {"depth": DepthMetrics(), "ssim": DepthSSIM(data_range=max_depth_m)}
    return MetricCollection(metrics | own, prefix=prefix, compute_groups=False)
