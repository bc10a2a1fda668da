"""Test protocols: everything that decides how predictions are scored, in one object.

The same predictions score differently with another crop, cap, mask or resolution, so a metric without its protocol
means nothing. :meth:`Protocol.stamp` goes into each metric file.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hudepth.base.errors import ConfigError
from hudepth.base.options import Choice, Range, check
from hudepth.metrics.alignment import ALIGNMENTS
from hudepth.metrics.catalogue import depth_names, metric_info
from hudepth.metrics.collection import Averaging
from hudepth.metrics.summary import SummaryOptions

_Positive = Annotated[float, Range(0, above=True)]
_Crop = Annotated[Sequence[int], Range(0), "[top,bottom,left,right]"]
_Shares = Annotated[Sequence[float], Range(0, 1), "[top,bottom,left,right] as shares of 1"]
_Size = Annotated[Sequence[int], Range(1), "[height,width]"]


@dataclass(frozen=True)
class Protocol:
    """How predictions are scored; raises :class:`ConfigError` for values out of range."""

    name: str
    resolution: Annotated[str, Choice(("network", "native"))] = "network"
    """``network``: prediction and ground truth at training size; ``native``: the prediction resized to the ground
    truth's size."""
    resize: Annotated[str, Choice(("bilinear", "bicubic", "nearest"))] = "bilinear"
    flip: bool = False
    """Average the network's prediction with that of the mirrored image. Trivial baselines are not mirrored."""
    alignment: Annotated[str, Choice(ALIGNMENTS)] = "none"
    """Align each prediction with its ground truth first: ``none``, ``median``, ``least_squares`` (scale and shift) or
    ``affine_inverse`` (scale and shift of inverse depth); see :mod:`hudepth.metrics.alignment`."""
    crop: _Crop | None = None
    """Rows and columns that count, in an image of ``crop_size``; None for all."""
    crop_size: _Size | None = (480, 640)
    """(height, width) the crop refers to; for images of another size it is scaled. None: it counts pixels of each image
    as it is, and smaller images are left out."""
    crop_shares: _Shares | None = None
    """Instead of ``crop``: top, bottom, left and right as shares of height and width, in pixels rounded down."""
    valid: Annotated[str, Choice(("open", "closed", "measured"))] = "open"
    """Which measured pixels count: ``open``: min_depth_m < depth < max_depth_m; ``closed``: the same with both ends;
    ``measured``: all of them, at any depth."""
    min_depth_m: Annotated[float, Range(0)] = 0.0
    max_depth_m: float | None = None
    """None for no upper cap."""
    clamp: bool = False
    """Clamp predictions to [min_depth_m, max_depth_m], after alignment."""
    averaging: Annotated[str, Choice(get_args(Averaging))] = "image"
    silog_lambda: Annotated[float, Range(0, 1)] = 1.0
    silog_factor: float = 100.0
    ssim_data_range_m: _Positive = 10.0
    """The largest possible difference, for SSIM."""
    ssim_window: Annotated[int, Range(1)] = 11
    boundary: bool = False
    """Also measure depth edges; see :mod:`hudepth.metrics.boundary`."""
    strata: bool = False
    """Also measure errors by depth, distance to an edge, region and category; see :mod:`hudepth.metrics.strata`."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Further entries for the stamp, for example the source."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w[\w.+-]*", str(self.name)):  # its results lie in a folder of that name
            raise ConfigError(
                f"protocol: '{self.name}' is not a name for a folder. Pass a word, as protocol.eigen.name=mine."
            )
        check(self, prefix=f"protocol.{self.name}.")
        key = f"protocol.{self.name}"
        if self.crop_size is not None and len(self.crop_size) != 2:
            raise ConfigError(f"{key}.crop_size: {list(self.crop_size)} is not [height,width].")
        if self.crop is not None and not _is_crop(self.crop, self.crop_size):
            within = f" within {list(self.crop_size)}" if self.crop_size else ""
            raise ConfigError(f"{key}.crop: {list(self.crop)} is not [top,bottom,left,right]{within}.")
        if self.crop_shares is not None and (self.crop is not None or not _is_crop(self.crop_shares, (1, 1))):
            wanted = "[top,bottom,left,right] between 0 and 1, with crop=null"
            raise ConfigError(f"{key}.crop_shares: {list(self.crop_shares)} is not {wanted}.")
        if self.max_depth_m is not None and self.max_depth_m <= self.min_depth_m:
            raise ConfigError(f"{key}.max_depth_m: {self.max_depth_m} is not above min_depth_m.")
        try:
            json.dumps({**self.extra}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{key}.extra: '{self.extra}' cannot be written as a JSON object.") from error

    @property
    def needs_native(self) -> bool:
        """Whether it scores at the ground truth's native resolution."""
        return self.resolution == "native"

    @property
    def summary_options(self) -> SummaryOptions:
        """Arguments of :func:`hudepth.metrics.summary.summarise` and of the bootstrap."""
        return {"averaging": self.averaging, "silog_lambda": self.silog_lambda, "silog_factor": self.silog_factor}

    @property
    def caps(self) -> tuple[str, float, float | None]:
        """What selects the measured pixels that count: equal caps, equal pixels."""
        return (self.valid, self.min_depth_m, self.max_depth_m)

    def within_caps(self, truth_m: Float[Tensor, "*shape"]) -> Bool[Tensor, "*shape"]:
        """Return which measured depths [m] count."""
        if self.valid == "measured":
            return torch.ones_like(truth_m, dtype=torch.bool)
        below, above = (torch.gt, torch.lt) if self.valid == "open" else (torch.ge, torch.le)
        within = below(truth_m, self.min_depth_m)
        return within if self.max_depth_m is None else within & above(truth_m, self.max_depth_m)

    def window(self, height: int, width: int) -> tuple[slice, slice] | None:
        """Return the rows and columns that count in an image of this size; None if the crop exceeds it or none do."""
        if self.crop_shares is not None:
            rows, columns = (slice(int(a * n), int(b * n)) for a, b, n in _sides(self.crop_shares, height, width))
            return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None
        if self.crop is None:
            return slice(0, height), slice(0, width)
        top, bottom, left, right = self.crop
        if self.crop_size is None:
            return (slice(top, bottom), slice(left, right)) if bottom <= height and right <= width else None
        y, x = height / self.crop_size[0], width / self.crop_size[1]
        top, bottom, left, right = round(top * y), round(bottom * y), round(left * x), round(right * x)
        return (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None

    def stamp(self) -> dict[str, Any]:
        """Return all that affects the numbers, for a metric file."""
        return {
            **self.extra,
            "name": self.name,
            "resolution": self.resolution,
            "resize": f"{self.resize}, align_corners=False" if self.needs_native else "none",
            "crop": list(self.crop) if self.crop else None,
            "crop_size": list(self.crop_size) if self.crop and self.crop_size else None,
            **({"crop_shares": list(self.crop_shares)} if self.crop_shares else {}),
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
            "units": {**{name: unit for name in depth_names() if (unit := metric_info(name).unit)}, "others": "1"},
        }

    def _valid_rule(self) -> str:
        if self.valid == "measured":
            return "measured"
        less = "<" if self.valid == "open" else "<="
        upper = "" if self.max_depth_m is None else f" {less} {self.max_depth_m:.15g} m"
        return f"measured, {self.min_depth_m:.15g} m {less} truth{upper}"


def _sides(shares: Sequence[float], height: int, width: int) -> list[tuple[float, float, int]]:
    top, bottom, left, right = shares
    return [(top, bottom, height), (left, right, width)]


def _is_crop(crop: Sequence[float], size: Sequence[float] | None) -> bool:
    ordered = len(crop) == 4 and crop[0] < crop[1] and crop[2] < crop[3]
    return ordered and (size is None or (crop[1] <= size[0] and crop[3] <= size[1]))
