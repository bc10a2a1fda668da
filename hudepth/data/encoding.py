"""How stored depth values become metres, and the check that the result is plausible.

Like the sources, this module does not import torch: worker processes import it and should start fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.base.options import Choice, convert

ENCODINGS = ("auto", "uint16_mm", "uint8_10m", "float_m", "linear", "paper_literal")
"""Values of ``data.encoding``; :func:`to_metres` explains them."""
Encoding = Annotated[str, Choice(ENCODINGS)]
"""One of :data:`ENCODINGS`, as the type of an option."""

INDOOR_MEDIAN_M = (0.3, 20.0)
"""Median depths [m] an indoor set can have; a wrong unit lands far outside."""

_FULL_SCALE_8BIT_M = 10.0  # DenseDepth's training PNGs: 255 is 10 m
_ADVICE_8BIT = (
    "Use data.encoding=uint8_10m for value/255*10 m, or data.encoding=paper_literal to read it so on purpose."
)


class DepthRange(NamedTuple):
    """Measured depths of a sample [m], and the share of pixels that are measured, in (0, 1]."""

    min_m: float
    median_m: float
    max_m: float
    valid_fraction: float


def resolve_encoding(
    encoding: str, *, dtype: np.dtype[Any], has_scale: bool, auto_uint8: str | None, where: str = ""
) -> str:
    """Return the encoding that ``auto`` stands for; any other name is returned as it is.

    Args:
        encoding: one of :data:`ENCODINGS`.
        dtype: of the stored values.
        has_scale: whether the record has a scale of its own; if so, ``auto`` is ``linear``.
        auto_uint8: encoding of 8-bit values in this source; None if only the user can know.

    Raises ConfigError if the name is unknown; DataError, of the file ``where``, if ``dtype`` does not determine it.
    """
    convert("data.encoding", encoding, Encoding)
    if encoding != "auto":
        return encoding
    if has_scale:
        return "linear"
    if dtype == np.uint8 and auto_uint8:
        return auto_uint8
    if dtype.kind == "f" or (dtype.kind == "u" and dtype.itemsize == 2):
        return "float_m" if dtype.kind == "f" else "uint16_mm"
    choices = "uint8_10m (value/255*10 m) or paper_literal (value/1000 m)" if dtype == np.uint8 else "uint16_mm"
    raise DataError(f"{_prefix(where)}the unit of {dtype} depth is unknown. Pass data.encoding={choices}.")


def to_metres(
    raw: NDArray[np.generic], encoding: str, *, scale_m: float | None = None, offset: float = 0.0,
    auto_uint8: str | None = None, where: str = "",
) -> NDArray[np.float32]:  # fmt: skip
    """Convert stored depth values to float32 metres [H, W], 0 where unmeasured.

    ============== ============================== =========================================
    encoding       stored values                  depth [m]
    ============== ============================== =========================================
    uint16_mm      integers of 16 bits or more    value / 1000
    uint8_10m      uint8                          value / 255 * 10 (DenseDepth's training PNGs)
    float_m        floating point                 value
    linear         any number                     (value + offset) * scale_m
    paper_literal  any integers                   value / 1000, 8-bit data included
    auto           any of the above               see :func:`resolve_encoding`
    ============== ============================== =========================================

    NaN, infinite, negative and zero depths count as unmeasured. A stored 0 is unmeasured too, except under
    ``linear``, where 0 is a value like any other.

    ``scale_m`` is in metres per unit of the stored value, ``offset`` in such units; ``where`` names the file in errors.
    Raises ConfigError if the encoding is unknown; DataError if the values do not fit it, or ``linear`` has no scale.
    """
    if raw.ndim != 2:
        raise DataError(f"{_prefix(where)}depth has shape {raw.shape}. Store one value per pixel, as [H, W].")
    has_scale = scale_m is not None
    name = resolve_encoding(encoding, dtype=raw.dtype, has_scale=has_scale, auto_uint8=auto_uint8, where=where)
    _check_values(raw, name, where)
    values = raw.astype(np.float64)  # float64: one rounding, at the end
    if name == "linear":
        values = (values + offset) * _check_scale(scale_m, offset, where)
    elif name == "uint8_10m":
        values = values / 255 * _FULL_SCALE_8BIT_M
    elif name != "float_m":
        values = values / 1000
    with np.errstate(over="ignore", invalid="ignore"):
        metres = values.astype(np.float32)
        metres[~(np.isfinite(metres) & (metres > 0))] = 0.0
    return metres


def check_range(depths: Sequence[NDArray[np.float32]], *, indoor: bool, encoding: str, name: str) -> DepthRange:
    """Measure the range of a sample of depths [H, W] in metres, 0 where unmeasured.

    Raises DataError if nothing is measured, or an indoor set's median is outside :data:`INDOOR_MEDIAN_M`, except under
    ``paper_literal``, which is implausible on purpose. ``name`` is the set's, for errors.
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
    low, high = INDOOR_MEDIAN_M
    if indoor and encoding != "paper_literal" and not low <= found.median_m <= high:
        raise DataError(
            f"data.encoding={encoding}: '{name}' has a median depth of {found.median_m:.3g} m, "
            f"indoor sets lie in {low:g} to {high:g} m. "
            f"Pass another data.encoding ({others}), or data.source.indoor=false for outdoor pairs."
        )
    return found


def _check_values(raw: NDArray[np.generic], name: str, where: str) -> None:
    integer, bits = raw.dtype.kind in "ui", raw.dtype.itemsize * 8
    if raw.dtype.kind not in "uif":
        raise DataError(f"{_prefix(where)}depth values of type {raw.dtype} are not numbers. Store integers or floats.")
    if name == "uint16_mm" and integer and bits == 8:
        largest = int(raw.max(initial=0))
        raise DataError(
            f"{_prefix(where)}8-bit data declared as millimetres "
            f"(largest value {largest} = {largest / 1000:g} m). {_ADVICE_8BIT}"
        )
    fits = {"uint8_10m": raw.dtype == np.uint8, "float_m": not integer, "linear": True}
    if not fits.get(name, integer):
        likely = "float_m" if not integer else "uint8_10m" if raw.dtype == np.uint8 else "uint16_mm"
        raise DataError(f"{_prefix(where)}{raw.dtype} data declared as {name}. Use data.encoding={likely}.")


def _check_scale(scale_m: float | None, offset: float, where: str) -> float:
    if scale_m is None:
        raise DataError(
            f"{_prefix(where)}data.encoding=linear needs a scale for each image, and there is none. "
            "Add the column depth_scale_m to the index, or pass another data.encoding."
        )
    if not (np.isfinite(scale_m) and scale_m > 0 and np.isfinite(offset)):
        raise DataError(
            f"{_prefix(where)}depth scale {scale_m} m with offset {offset}. "
            "The scale must be positive and both must be finite."
        )
    return scale_m


def _prefix(where: str) -> str:
    return f"{where}: " if where else ""
