"""Test protocols: everything that decides what number a prediction gets, in one object that states itself.

The same predictions score differently under another crop, cap, mask or resolution, so a metric without its protocol
means nothing. :meth:`Protocol.stamp` is what a metric file says.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.metrics.alignment import ALIGNMENTS
from hudepth.metrics.collection import AVERAGINGS

RESOLUTIONS = ("network", "native")
RESIZES = ("bilinear", "bicubic", "nearest")
VALID_RULES = ("open", "closed", "measured")


class SummaryOptions(TypedDict):
    """Keyword arguments of :func:`hudepth.metrics.summary.summarise` and of the bootstrap."""

    averaging: str
    silog_lambda: float
    silog_factor: float


@dataclass(frozen=True)
class Protocol:
    """How predictions are scored.

    Raises:
        ConfigError: for values out of range.
    """

    name: str
    resolution: str = "network"
    """``network``: prediction and truth at training size; ``native``: prediction resized to the truth's."""
    resize: str = "bilinear"
    """How: ``bilinear``, ``bicubic`` or ``nearest``."""
    flip: bool = False
    """Average the network's prediction with that of the mirrored image. Trivial baselines are not mirrored."""
    alignment: str = "none"
    """Bring each prediction onto the scale of its truth first: ``none``, ``median``, ``least_squares`` (scale and
    shift) or ``affine_inverse`` (scale and shift of inverse depth); see :mod:`hudepth.metrics.alignment`."""
    crop: Sequence[int] | None = None
    """Rows and columns that count, [top, bottom, left, right] in an image of ``crop_size``; None for all."""
    crop_size: Sequence[int] | None = (480, 640)
    """(height, width) the crop refers to; for images of another size it is scaled. None: it counts pixels of each image
    as it is, and images that it exceeds are left out."""
    valid: str = "open"
    """Which measured pixels count: ``open``: min_depth_m < truth < max_depth_m; ``closed``: the same with both ends;
    ``measured``: all of them, whatever their depth."""
    min_depth_m: float = 0.0
    max_depth_m: float | None = None
    """None for no upper cap."""
    clamp: bool = False
    """Clamp predictions to [min_depth_m, max_depth_m], after alignment."""
    averaging: str = "image"
    """``image``: metrics of each image, then their mean; ``pooled``: over all pixels of the subset at once."""
    silog_lambda: float = 1.0
    silog_factor: float = 100.0
    ssim_data_range_m: float = 10.0
    """What SSIM takes for the largest possible difference."""
    ssim_window: int = 11
    boundary: bool = False
    """Also measure depth edges; see :mod:`hudepth.metrics.boundary`."""
    strata: bool = False
    """Also measure errors by depth, distance to an edge, region and category; see :mod:`hudepth.metrics.strata`."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Further words for the stamp, for example the source."""

    def __post_init__(self) -> None:
        for key, value, choices in (
            ("resolution", self.resolution, RESOLUTIONS),
            ("resize", self.resize, RESIZES),
            ("alignment", self.alignment, ALIGNMENTS),
            ("valid", self.valid, VALID_RULES),
            ("averaging", self.averaging, AVERAGINGS),
        ):
            if value not in choices:
                raise ConfigError(
                    f"protocol.{self.name}.{key}: no '{value}'.{did_you_mean(str(value), choices)} "
                    f"Pass one of {', '.join(choices)}."
                )
        self._check_kinds()
        size = self.crop_size
        if size is not None and (not _are_pixels(size, 2) or min(size) < 1):
            raise ConfigError(f"protocol.{self.name}.crop_size: {_spelt(size)} is not [height,width].")
        if self.crop is not None and not (_are_pixels(self.crop, 4) and _is_crop(self.crop, size)):
            within = f" within {_spelt(size)}" if size else ""
            raise ConfigError(f"protocol.{self.name}.crop: {_spelt(self.crop)} is not [top,bottom,left,right]{within}.")
        if self.min_depth_m < 0:
            raise ConfigError(f"protocol.{self.name}.min_depth_m: {self.min_depth_m} is negative.")
        if self.max_depth_m is not None and self.max_depth_m <= self.min_depth_m:
            raise ConfigError(f"protocol.{self.name}.max_depth_m: {self.max_depth_m} is not above min_depth_m.")
        if not 0 <= self.silog_lambda <= 1:
            raise ConfigError(f"protocol.{self.name}.silog_lambda: {self.silog_lambda} is not in [0, 1].")
        if self.ssim_data_range_m <= 0 or self.ssim_window < 1:
            raise ConfigError(f"protocol.{self.name}: ssim_data_range_m and ssim_window must be positive.")

    def _check_kinds(self) -> None:
        name = self.name
        if not re.fullmatch(r"\w[\w.+-]*", str(name)):  # its results lie in a folder of that name
            raise ConfigError(f"protocol: '{name}' is no name for a folder. Pass a word, as protocol.eigen.name=mine.")
        for key in ("flip", "clamp", "boundary", "strata"):
            if not isinstance(getattr(self, key), bool):
                raise ConfigError(f"protocol.{name}.{key}: '{getattr(self, key)}' is neither true nor false.")
        for key in ("min_depth_m", "max_depth_m", "silog_lambda", "silog_factor", "ssim_data_range_m"):
            value = getattr(self, key)
            if not (_is_finite(value) or (key == "max_depth_m" and value is None)):
                raise ConfigError(f"protocol.{name}.{key}: '{value}' is no finite number.")
        try:
            json.dumps({**self.extra}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"protocol.{name}.extra: '{self.extra}' cannot be written as a JSON object.") from error
        if not _are_pixels([self.ssim_window], 1):
            raise ConfigError(f"protocol.{name}.ssim_window: '{self.ssim_window}' is no whole number of pixels.")

    @property
    def needs_native(self) -> bool:
        """Whether it scores against native-resolution truth."""
        return self.resolution == "native"

    @property
    def summary_options(self) -> SummaryOptions:
        """What turns the metrics of images into those of a subset; see :mod:`hudepth.metrics.summary`."""
        return {"averaging": self.averaging, "silog_lambda": self.silog_lambda, "silog_factor": self.silog_factor}

    @property
    def caps(self) -> tuple[str, float, float | None]:
        """What decides which measured pixels count: equal caps, equal pixels."""
        return (self.valid, self.min_depth_m, self.max_depth_m)

    def within_caps(self, truth_m: Float[Tensor, "*shape"]) -> Bool[Tensor, "*shape"]:
        """Tell which measured depths [m] count."""
        if self.valid == "measured":
            return torch.ones_like(truth_m, dtype=torch.bool)
        below, above = (torch.gt, torch.lt) if self.valid == "open" else (torch.ge, torch.le)
        within = below(truth_m, self.min_depth_m)
        return within if self.max_depth_m is None else within & above(truth_m, self.max_depth_m)

    def window(self, height: int, width: int) -> tuple[slice, slice] | None:
        """Return the rows and columns that count in an image of this size; None if the crop exceeds it or none do."""
        if self.crop is None:
            return slice(0, height), slice(0, width)
        top, bottom, left, right = self.crop
        if self.crop_size is None:
            return (slice(top, bottom), slice(left, right)) if bottom <= height and right <= width else None
        y, x = height / self.crop_size[0], width / self.crop_size[1]
        top, bottom, left, right = round(top * y), round(bottom * y), round(left * x), round(right * x)
        return (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None

    def stamp(self) -> dict[str, Any]:
        """Return all that decides the numbers, for a metric file."""
        return {
            **self.extra,
            "name": self.name,
            "resolution": self.resolution,
            "resize": f"{self.resize}, align_corners=False" if self.needs_native else "none",
            "crop": list(self.crop) if self.crop else None,
            "crop_size": list(self.crop_size) if self.crop and self.crop_size else None,
            "valid": self._valid_rule(),
            "clamp_m": [self.min_depth_m, self.max_depth_m] if self.clamp else None,
            "averaging": self.averaging,
            "alignment": self.alignment,
            "test_time_flip": self.flip,
            "silog": {"lambda": self.silog_lambda, "factor": self.silog_factor},
            "ssim": {
                "window": self.ssim_window,
                "sigma": 1.5,
                "data_range_m": self.ssim_data_range_m,
                "averaging": "image, windows of valid pixels only",
            },
            "units": UNITS,
        }

    def _valid_rule(self) -> str:
        less = "<" if self.valid == "open" else "<="
        if self.valid == "measured":
            return "measured"
        upper = "" if self.max_depth_m is None else f" {less} {self.max_depth_m:.15g} m"
        return f"measured, {self.min_depth_m:.15g} m {less} truth{upper}"


def _is_finite(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _are_pixels(values: object, count: int) -> bool:
    return isinstance(values, (list, tuple)) and len(values) == count and all(type(value) is int for value in values)


def _spelt(values: object) -> str:
    return str(list(values) if isinstance(values, tuple) else values)


def _is_crop(crop: Sequence[int], size: Sequence[int] | None) -> bool:
    if not (0 <= crop[0] < crop[1] and 0 <= crop[2] < crop[3]):
        return False
    return size is None or (crop[1] <= size[0] and crop[3] <= size[1])


UNITS = {"mae": "m", "rmse": "m", "sq_rel": "m", "mse": "m^2", "others": "1"}
