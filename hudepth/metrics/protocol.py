"""Test protocols: everything that decides what number a prediction gets, in one object that states itself.

The same predictions score differently under another crop, cap, mask or resolution, so a metric without its protocol
means nothing. :meth:`Protocol.stamp` is what a metric file says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from hudepth.errors import ConfigError, did_you_mean
from hudepth.metrics.collection import AVERAGINGS
from hudepth.metrics.depth import SUM_NAMES, depth_metrics_from_sums, depth_sums
from hudepth.metrics.ssim import ssim
from hudepth.types import Batch

RESOLUTIONS = ("network", "native")


@dataclass(frozen=True)
class Protocol:
    """How predictions are scored.

    Raises:
        ConfigError: for values out of range.
    """

    name: str
    resolution: str = "network"
    """``network``: prediction and truth at training size; ``native``: prediction resized bilinearly to the truth's."""
    crop: Sequence[int] | None = None
    """Rows and columns that count, [top, bottom, left, right] in an image of ``crop_size``; None for all."""
    crop_size: Sequence[int] = (480, 640)
    """(height, width) the crop refers to; for images of another size it is scaled."""
    min_depth_m: float = 0.0
    """A pixel counts where min_depth_m < truth < max_depth_m, both excluded."""
    max_depth_m: float | None = None
    """None for no upper cap."""
    clamp: bool = False
    """Clamp predictions to [min_depth_m, max_depth_m] first."""
    averaging: str = "image"
    """``image``: metrics of each image, then their mean; ``pooled``: over all pixels of the subset at once."""
    silog_lambda: float = 1.0
    silog_factor: float = 100.0
    ssim_data_range_m: float = 10.0
    """What SSIM takes for the largest possible difference."""
    ssim_window: int = 11
    extra: dict[str, Any] = field(default_factory=dict)
    """Further words for the stamp, for example the source."""

    def __post_init__(self) -> None:
        for key, value, choices in (
            ("resolution", self.resolution, RESOLUTIONS),
            ("averaging", self.averaging, AVERAGINGS),
        ):
            if value not in choices:
                raise ConfigError(
                    f"protocol.{self.name}.{key}: no '{value}'.{did_you_mean(value, choices)} "
                    f"Pass one of {', '.join(choices)}."
                )
        if len(self.crop_size) != 2 or min(self.crop_size) < 1:
            raise ConfigError(f"protocol.{self.name}.crop_size: {list(self.crop_size)} is not [height,width].")
        if self.crop is not None and not _is_crop(self.crop, self.crop_size):
            raise ConfigError(
                f"protocol.{self.name}.crop: {list(self.crop)} is not [top,bottom,left,right] "
                f"within {list(self.crop_size)}."
            )
        if self.min_depth_m < 0:
            raise ConfigError(f"protocol.{self.name}.min_depth_m: {self.min_depth_m} is negative.")
        if self.max_depth_m is not None and self.max_depth_m <= self.min_depth_m:
            raise ConfigError(f"protocol.{self.name}.max_depth_m: {self.max_depth_m} is not above min_depth_m.")
        if not 0 <= self.silog_lambda <= 1:
            raise ConfigError(f"protocol.{self.name}.silog_lambda: {self.silog_lambda} is not in [0, 1].")
        if self.ssim_data_range_m <= 0 or self.ssim_window < 1:
            raise ConfigError(f"protocol.{self.name}: ssim_data_range_m and ssim_window must be positive.")

    @property
    def needs_native(self) -> bool:
        """Whether it scores against native-resolution truth."""
        return self.resolution == "native"

    def score(self, pred_m: Float[Tensor, "b 1 h w"], batch: Batch, *, max_depth_m: float) -> Float[Tensor, "b k"]:
        """Return the sums of each image, one row an image, columns as in :data:`SUM_COLUMNS`.

        Args:
            pred_m: predicted depth at network resolution [m].
            batch: holds the truth.
            max_depth_m: what unit depth 1 stands for in the batch.

        Raises:
            ConfigError: if the protocol needs native truth and the batch has none.
        """
        if not self.needs_native:
            return self._sums(pred_m, batch["unit_depth"] * max_depth_m, batch["valid"])
        if "native_depth" not in batch:
            raise ConfigError(
                f"protocol={self.name} scores at native resolution, which this store was prepared without. "
                "Pass data.native=true, or protocol=paper."
            )
        rows = []
        for pred, native in zip(pred_m, batch["native_depth"], strict=True):
            truth = native[None].to(pred.device)
            full = functional.interpolate(pred[None], size=truth.shape[-2:], mode="bilinear", align_corners=False)
            rows.append(self._sums(full, truth, truth > 0))
        return torch.cat(rows)

    def _sums(
        self, pred_m: Float[Tensor, "b 1 h w"], truth_m: Float[Tensor, "b 1 h w"], measured: Bool[Tensor, "b 1 h w"]
    ) -> Float[Tensor, "b k"]:
        if self.clamp:
            pred_m = pred_m.clamp(self.min_depth_m, self.max_depth_m)
        rows, columns = self.window(*truth_m.shape[-2:])
        pred_m, truth_m, valid = (x[..., rows, columns] for x in (pred_m, truth_m, measured))
        valid = valid & (truth_m > self.min_depth_m)
        if self.max_depth_m is not None:
            valid = valid & (truth_m < self.max_depth_m)
        similarity = ssim(pred_m, truth_m, valid, data_range=self.ssim_data_range_m, window=self.ssim_window)
        return torch.stack([*depth_sums(pred_m, truth_m, valid).values(), similarity.double()], dim=1)

    def window(self, height: int, width: int) -> tuple[slice, slice]:
        """Return the rows and columns that count in an image of this size."""
        if self.crop is None:
            return slice(None), slice(None)
        top, bottom, left, right = self.crop
        y, x = height / self.crop_size[0], width / self.crop_size[1]
        return slice(round(top * y), round(bottom * y)), slice(round(left * x), round(right * x))

    def stamp(self) -> dict[str, Any]:
        """Return all that decides the numbers, for a metric file."""
        return {
            **self.extra,
            "name": self.name,
            "resolution": self.resolution,
            "resize": "bilinear, align_corners=False" if self.needs_native else "none",
            "crop": list(self.crop) if self.crop else None,
            "crop_size": list(self.crop_size) if self.crop else None,
            "valid": f"measured, {self.min_depth_m:.15g} m < truth"
            + ("" if self.max_depth_m is None else f" < {self.max_depth_m:.15g} m"),
            "clamp_m": [self.min_depth_m, self.max_depth_m] if self.clamp else None,
            "averaging": self.averaging,
            "alignment": "none",
            "test_time_flip": False,
            "silog": {"lambda": self.silog_lambda, "factor": self.silog_factor},
            "ssim": {
                "window": self.ssim_window,
                "sigma": 1.5,
                "data_range_m": self.ssim_data_range_m,
                "averaging": "image, windows of valid pixels only",
            },
            "units": UNITS,
        }

    def per_image(self, sums: Float[Tensor, "n k"]) -> dict[str, Float[Tensor, " n"]]:
        """Return the metrics of each image from its sums; NaN where no pixel counts."""
        return {**self._finish(sums.T), "ssim": sums[:, -1]}

    def summary(self, sums: Float[Tensor, "n k"]) -> dict[str, float]:
        """Return the metrics of the subset from the sums of its images, averaged as the protocol says.

        Images without a pixel that counts are skipped. A prediction that is NaN where a pixel counts makes the metric
        NaN: skipping it would flatter the model.

        Raises:
            ConfigError: if no pixel of any image counts.
        """
        counted = sums[sums[:, 0] > 0]
        if not len(counted):
            raise ConfigError(
                f"protocol={self.name}: no pixel of {len(sums)} images counts; look at its crop and caps."
            )
        metrics = self._finish(counted.T if self.averaging == "image" else counted.sum(dim=0))
        ssim_mean = counted[:, -1].nanmean()  # NaN where an image has no whole window of valid pixels
        return {**{name: values.mean().item() for name, values in metrics.items()}, "ssim": ssim_mean.item()}

    def _finish(self, columns: Float[Tensor, k * n]) -> dict[str, Float[Tensor, "*n"]]:
        sums = dict(zip(SUM_COLUMNS, columns, strict=True))
        del sums["ssim"]
        return depth_metrics_from_sums(sums, silog_lambda=self.silog_lambda, silog_factor=self.silog_factor)


def _is_crop(crop: Sequence[int], size: Sequence[int]) -> bool:
    return len(crop) == 4 and 0 <= crop[0] < crop[1] <= size[0] and 0 <= crop[2] < crop[3] <= size[1]


UNITS = {"mae": "m", "rmse": "m", "sq_rel": "m", "mse": "m^2", "others": "1"}
SUM_COLUMNS = (*SUM_NAMES, "ssim")
"""Columns of :meth:`Protocol.score`: those of :func:`hudepth.metrics.depth.depth_sums`, then each image's ssim."""
