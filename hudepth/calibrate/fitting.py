"""Fit a calibration to measured depths, and find out by cross-validation whether it helps.

A fit minimises the squared error of log depth, averaged over each image's pixels and then over images, so that all
images weigh the same. With x and y the logarithms of predicted and measured depth:

    scale             y = a + x          a = mean(y - x)
    scale and power   y = a + b x        b = cov(x, y) / var(x), a = mean(y) - b mean(x)

Each image is corrected by a fit on images of other scenes, and its error compared with that of the model as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.inference.calibration import Calibration
from hudepth.metrics.bootstrap import Difference, paired_differences
from hudepth.metrics.summary import ImageTable

Floats = NDArray[np.float64]
FOLDS = 10
MOST_RATIO = 4.0
"""Of measured to predicted depth, on the mean of logarithms: other cameras and rooms differ by less, units by more."""
MIN_LOG_SPREAD = 0.1
"""Standard deviation of log depth below which a power cannot be told from a scale."""


@dataclass(frozen=True)
class Measured:
    """Predicted and measured depths [m] of an image, [n] each, all positive."""

    id: str
    scene: str
    """Empty: a scene of its own."""
    pred_m: Floats
    truth_m: Floats


@dataclass(frozen=True)
class Trial:
    """What a kind of calibration does to images that it was not fitted on."""

    calibration: Calibration
    """Fitted on all images."""
    abs_rel: float
    change: Difference
    """Of abs_rel to the model as it is; an interval of NaN if there are fewer than five scenes."""

    @property
    def helps(self) -> bool:
        """Whether it lowers the error, beyond what other scenes might have shown if there is an interval."""
        return self.change.value < 0 if math.isnan(self.change.high) else self.change.high < 0


def check_unit(images: Sequence[Measured]) -> None:
    """Raise DataError if measured depth is so far from the predicted that it must be in another unit."""
    ratio = math.exp(float(np.mean([np.mean(np.log(image.truth_m / image.pred_m)) for image in images])))
    if not 1 / MOST_RATIO <= ratio <= MOST_RATIO:
        raise DataError(
            f"data: measured depth is {ratio:.3g} times what is predicted, so its unit is wrong. "
            "Check data.encoding, or that the points are in metres."
        )


def fit_scale(images: Sequence[Measured]) -> Calibration | None:
    """Return the scale that fits best."""
    shift = float(np.mean([np.mean(np.log(image.truth_m) - np.log(image.pred_m)) for image in images]))
    return _usable(math.exp(shift), 1.0)


def fit_power(images: Sequence[Measured]) -> Calibration | None:
    """Return the scale and power that fit best; None if depths are too much alike to tell."""
    logs = [(np.log(image.pred_m), np.log(image.truth_m)) for image in images]
    moments = [(x.mean(), y.mean(), (x * x).mean(), (x * y).mean()) for x, y in logs]
    mean_x, mean_y, mean_xx, mean_xy = np.mean(moments, axis=0)
    variance = mean_xx - mean_x**2
    if variance < MIN_LOG_SPREAD**2:
        return None
    power = float((mean_xy - mean_x * mean_y) / variance)
    return _usable(math.exp(float(mean_y - power * mean_x)), power)


def _usable(scale: float, power: float) -> Calibration | None:
    return Calibration(scale, power) if 1e-3 <= scale <= 1e3 and 0.1 <= power <= 10 else None


KINDS: dict[str, Callable[[Sequence[Measured]], Calibration | None]] = {
    "scale": fit_scale, "scale and power": fit_power,
}  # fmt: skip


def abs_rel(image: Measured, calibration: Calibration | None = None) -> float:
    """Return the mean relative error of an image."""
    pred = image.pred_m if calibration is None else calibration.apply(image.pred_m)
    return float(np.mean(np.abs(pred - image.truth_m) / image.truth_m))


def try_kinds(images: Sequence[Measured]) -> dict[str, Trial]:
    """Return how well each kind of calibration does on images that it was not fitted on; kinds that fail are left out.

    Raises DataError if all depths are of one image of one scene: nothing is left to compare with.
    """
    scenes = [image.scene or image.id for image in images]
    names = sorted(set(scenes))
    if len(names) < 2:
        raise DataError("data: all depths are of one scene, so no fit can be checked. Add pictures of another one.")
    order = np.random.default_rng(0).permutation(len(names))
    fold = {names[scene]: number % min(FOLDS, len(names)) for number, scene in enumerate(order)}
    before = _table(images, [abs_rel(image) for image in images])
    trials = {}
    for kind, fit in KINDS.items():
        whole = fit(images)
        fits = {
            number: fit([image for image, scene in zip(images, scenes, strict=True) if fold[scene] != number])
            for number in set(fold.values())
        }
        if whole is None or None in fits.values():
            continue
        errors = [abs_rel(image, fits[fold[scene]]) for image, scene in zip(images, scenes, strict=True)]
        change = paired_differences(before, _table(images, errors), averaging="image")["abs_rel"]
        trials[kind] = Trial(whole, float(np.mean(errors)), change)
    return trials


def choose(trials: dict[str, Trial]) -> str | None:
    """Return the kind to keep, None if none helps: the scale alone, unless a power lowers its error by 2 % more."""
    helping = {kind: trial for kind, trial in trials.items() if trial.helps}
    if "scale" in helping and "scale and power" in helping:
        return "scale and power" if helping["scale and power"].abs_rel < 0.98 * helping["scale"].abs_rel else "scale"
    return next(iter(helping), None)


def _table(images: Sequence[Measured], errors: Sequence[float]) -> ImageTable:
    count = len(images)
    ids, scenes = [image.id for image in images], [image.scene for image in images]
    return ImageTable(ids, scenes, [""] * count, np.ones(count, np.int64), {"abs_rel": np.asarray(errors)})
