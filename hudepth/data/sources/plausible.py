"""Whether depths read in some encoding can be those of a room, and which encoding would make them so."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.data.encoding import ENCODINGS, PER_M, to_metres

INDOOR_MEDIAN_M = (0.3, 20.0)
"""Median depths [m] an indoor set can have; a wrong unit lands far outside."""
FAR_INDOORS_M = 8.0
"""An indoor set with a median beyond it [m] gets a warning."""

_AUTO_MEDIAN_M = (0.8, FAR_INDOORS_M)
_AUTO_MAX_M = 15.0  # sensors that store 16-bit millimetres see no farther; KITTI read so reaches 20 m
_AUTO_ASPECT = 2.5  # width over height: no depth camera for rooms is as wide as KITTI's, 3.3


class DepthRange(NamedTuple):
    """Measured depths of a sample [m], and the share of pixels that are measured, in (0, 1]."""

    min_m: float
    median_m: float
    max_m: float
    valid_fraction: float


def check_range(
    depths: Sequence[NDArray[np.float32]], *, indoor: bool, encoding: str, name: str,
    usual_m: tuple[float, float] | None = None, raws: Sequence[NDArray[np.generic]] = (),
) -> DepthRange:  # fmt: skip
    """Measure the range of a sample of depths [H, W] in metres, 0 where unmeasured.

    Raises DataError if nothing is measured, if an indoor set's median is outside :data:`INDOOR_MEDIAN_M`, except under
    ``paper_literal``, which is implausible on purpose, or if ``auto`` would take values for millimetres that need not
    be any. ``name`` is the set's, for errors; they name encodings that would make ``raws``, the same depths as
    stored, plausible for a room. ``usual_m``: medians [m] a known set can have; others are refused.
    """
    others = ", ".join(other for other in ENCODINGS if other not in (encoding, "auto"))
    measured = np.concatenate([depth[depth > 0] for depth in depths] or [np.zeros(0, np.float32)])
    if measured.size == 0:
        raise DataError(
            f"data.encoding={encoding}: no pixel of '{name}' is measured in {len(depths)} depth maps. "
            f"Check data.root, or pass another data.encoding ({others})."
        )
    share = measured.size / sum(depth.size for depth in depths)
    found = DepthRange(float(measured.min()), float(np.median(measured)), float(measured.max()), share)
    if encoding == "auto":
        _check_guess(found, raws, indoor=indoor, name=name)
    if usual_m and encoding != "paper_literal" and not usual_m[0] <= found.median_m <= usual_m[1]:
        raise DataError(
            f"data.encoding={encoding}: '{name}' has a median depth of {found.median_m:.3g} m, the set's own lie in "
            f"{usual_m[0]:g} to {usual_m[1]:g} m. Leave data.encoding out, or copy the files again."
        )
    low, high = INDOOR_MEDIAN_M
    if indoor and encoding != "paper_literal" and not low <= found.median_m <= high:
        raise DataError(
            f"data.encoding={encoding}: '{name}' has a median depth of {found.median_m:.3g} m, "
            f"indoor sets lie in {low:g} to {high:g} m. Pass "
            f"{suggest(raws) or f'another data.encoding ({others})'}, or data.source.indoor=false for outdoor pairs."
        )
    return found


def _check_guess(found: DepthRange, raws: Sequence[NDArray[np.generic]], *, indoor: bool, name: str) -> None:
    """Refuse what ``auto`` takes for millimetres or metres if it may as well be something else."""
    usual = _AUTO_MEDIAN_M[0] <= found.median_m <= _AUTO_MEDIAN_M[1]
    wide = any(raw.shape[1] > _AUTO_ASPECT * raw.shape[0] for raw in raws)
    usual = usual and found.max_m <= _AUTO_MAX_M and not wide
    if any(raw.dtype == np.uint16 for raw in raws) and not (indoor and usual):
        raise DataError(
            f"data.encoding=auto: '{name}' holds 16-bit depth with a median of {found.median_m:.3g} m and up to "
            f"{found.max_m:.3g} m if it is millimetres, but it may be KITTI's 1/256 m or another unit. Pass "
            f"{suggest(raws) or 'data.encoding=uint16_256 (KITTI) or uint16_mm'}, or another data.encoding."
        )
    if indoor and found.median_m < _AUTO_MEDIAN_M[0] and any(raw.dtype.kind == "f" for raw in raws):
        raise DataError(
            f"data.encoding=auto: '{name}' has a median depth of {found.median_m:.3g} m if it is metres, but it may be "
            "inverse depth. Pass data.encoding=float_m, or data.encoding=disparity data.depth_scale_m=1."
        )


def suggest(raws: Sequence[NDArray[np.generic]]) -> str:
    """Return the encodings that give stored depths a median typical of rooms, each with it; empty if none does."""
    found: list[str] = []
    # The lowest bits of SUN RGB-D are the highest of the depth, which rooms leave empty.
    rotated = ["sunrgbd"] if all(map(_looks_rotated, raws)) else []
    for name in (*rotated, *PER_M, "uint8_10m"):
        if name == "paper_literal":  # wrong on purpose
            continue
        try:
            depths = [depth[depth > 0] for depth in (to_metres(raw, name) for raw in raws)]
        except DataError:
            continue
        median = float(np.median(np.concatenate(depths))) if any(map(len, depths)) else 0.0
        if 0.5 <= median <= FAR_INDOORS_M and not (name == "mm" and any("uint16_mm" in text for text in found)):
            found.append(f"data.encoding={name} (median {median:.2g} m)")
    return " or ".join(found)


def _looks_rotated(raw: NDArray[np.generic]) -> bool:
    return raw.dtype == np.uint16 and bool(np.mean(raw.astype(np.uint16) & 7 == 0) > 0.9)


def looks_swapped(raw: NDArray[np.generic]) -> bool:
    """Return whether 16-bit values [H, W] are noise as they are, but a smooth surface with their bytes swapped."""
    if raw.dtype not in (np.uint16, np.int16) or raw.shape[1] < 2:
        return False
    given, swapped = (np.abs(np.diff(values.astype(np.float64))).mean() for values in (raw, raw.byteswap()))
    return bool(given > 0.1 * np.ptp(raw.astype(np.float64)) and swapped < given / 8)
