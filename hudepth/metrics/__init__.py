"""Depth metrics, SSIM, and the protocols that decide what is scored.

The classes are torchmetrics; they are imported on first use, so that the catalogue is available without torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hudepth.metrics.catalogue import MetricInfo, metric_info, register

if TYPE_CHECKING:
    from hudepth.metrics.collection import (
        MAE,
        MSE,
        RMSE,
        AbsRel,
        Delta,
        DepthMetrics,
        DepthSSIM,
        Log10,
        RMSELog,
        SILog,
        SqRel,
    )

__all__ = [
    "MAE", "MSE", "RMSE", "AbsRel", "Delta", "DepthMetrics", "DepthSSIM", "Log10", "MetricInfo", "RMSELog", "SILog",
    "SqRel", "metric_info", "register",
]  # fmt: skip


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name in __all__:
            return getattr(import_module("hudepth.metrics.collection"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
