"""How stored depth values become metres.

Like the sources, this module does not import torch: worker processes import it and should start fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.base.options import Choice, convert

PER_M = {
    "uint16_mm": 1000, "uint16_256": 256, "uint16_4000": 4000, "uint16_5000": 5000, "uint16_10000": 10_000,
    "mm": 1000, "cm": 100, "float_m": 1, "paper_literal": 1000,
}  # fmt: skip
"""Encodings that only state how many stored values make a metre."""
ENCODINGS = ("auto", *PER_M, "uint8_10m", "sunrgbd", "linear", "disparity")
"""Values of ``data.encoding``; :func:`to_metres` explains them."""
Encoding = Annotated[str, Choice(ENCODINGS)]
"""One of :data:`ENCODINGS`, as the type of an option."""

_FULL_SCALE_8BIT_M = 10.0  # DenseDepth's training PNGs: 255 is 10 m
_ADVICE_8BIT = (
    "Use data.encoding=uint8_10m for value/255*10 m, or data.encoding=paper_literal to read it so on purpose."
)


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
    auto_uint8: str | None = None, invalid: Sequence[float] | None = None, where: str = "",
) -> NDArray[np.float32]:  # fmt: skip
    """Convert stored depth values to float32 metres [H, W], 0 where unmeasured.

    ============== ============================== =========================================
    encoding       stored values                  depth [m]
    ============== ============================== =========================================
    uint16_mm      integers of 16 bits or more    value / 1000
    uint16_256     likewise                       value / 256 (KITTI)
    uint16_4000    likewise                       value / 4000 (Matterport3D)
    uint16_5000    likewise                       value / 5000 (TUM RGB-D)
    uint16_10000   likewise                       value / 10000
    sunrgbd        uint16                         (value >> 3 | value << 13) / 1000 (SUN RGB-D)
    mm, cm         any number                     value / 1000, value / 100
    float_m        floating point                 value
    uint8_10m      uint8                          value / 255 * 10 (DenseDepth's training PNGs)
    linear         any number                     (value + offset) * scale_m
    disparity      any number                     scale_m / (value + offset)
    paper_literal  any integers                   value / 1000, 8-bit data included
    auto           any of the above               see :func:`resolve_encoding`
    ============== ============================== =========================================

    Depths that are NaN, infinite, negative or zero count as unmeasured. So does a stored 0, except under ``linear``,
    where 0 is a value like any other, and what is in ``invalid``: by default, the largest value of an integer type of
    16 bits or more. ``scale_m`` is in metres per unit of the stored value, for ``disparity`` focal length [pixels]
    times baseline [m], 1 for inverse depth; ``offset`` is in units of the stored value; ``where`` names the file in
    errors. Raises ConfigError if the encoding is unknown; DataError if values do not fit it, or a scale is missing.
    """
    if raw.ndim != 2:
        raise DataError(f"{_prefix(where)}depth has shape {raw.shape}. Store one value per pixel, as [H, W].")
    scaled = scale_m is not None
    name = resolve_encoding(encoding, dtype=raw.dtype, has_scale=scaled, auto_uint8=auto_uint8, where=where)
    _check_values(raw, name, where)
    values = raw.astype(np.float64)  # float64: one rounding, at the end
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        if name == "linear":
            values = (values + offset) * _check_scale(name, scale_m, offset, where)
        elif name == "disparity":
            values = _check_scale(name, scale_m, offset, where) / (values + offset)
        elif name == "uint8_10m":
            values = values / 255 * _FULL_SCALE_8BIT_M
        elif name == "sunrgbd":
            values = _rotated(raw.astype(np.uint16)) / 1000
        else:
            values = values / PER_M[name]
        metres = values.astype(np.float32)
        metres[~(np.isfinite(metres) & (metres > 0)) | is_invalid(raw, invalid)] = 0.0
    return metres


def is_invalid(raw: NDArray[np.generic], invalid: Sequence[float] | None) -> NDArray[np.bool_]:
    """Return where stored values mean "no reading"; None: at the largest of an integer type of 16 bits or more."""
    if invalid is None:
        if raw.dtype.kind not in "ui" or raw.dtype.itemsize == 1:
            return np.zeros(raw.shape, bool)
        return np.asarray(raw == np.iinfo(raw.dtype.str).max)
    values = np.asarray(invalid, np.float64)
    if raw.dtype.kind == "f":
        values = values.astype(raw.dtype).astype(np.float64)  # as the files round it
    return np.isin(raw.astype(np.float64), values)


def _rotated(raw: NDArray[np.uint16]) -> NDArray[np.uint16]:
    return (raw >> 3 | raw << 13).astype(np.uint16)


def _check_values(raw: NDArray[np.generic], name: str, where: str) -> None:
    integer, bits = raw.dtype.kind in "ui", raw.dtype.itemsize * 8
    if raw.dtype.kind not in "uif":
        raise DataError(f"{_prefix(where)}depth values of type {raw.dtype} are not numbers. Store integers or floats.")
    if name in ("uint16_mm", "mm") and integer and bits == 8:
        largest = int(raw.max(initial=0))
        raise DataError(
            f"{_prefix(where)}8-bit data declared as millimetres "
            f"(largest value {largest} = {largest / 1000:g} m). {_ADVICE_8BIT}"
        )
    any_number = dict.fromkeys(("linear", "disparity", "mm", "cm"), True)
    fits = {"uint8_10m": raw.dtype == np.uint8, "sunrgbd": raw.dtype == np.uint16, "float_m": not integer, **any_number}
    if not fits.get(name, integer and (bits > 8 or name == "paper_literal")):
        likely = "float_m, mm or cm" if not integer else "uint8_10m" if raw.dtype == np.uint8 else "uint16_mm"
        raise DataError(f"{_prefix(where)}{raw.dtype} data declared as {name}. Use data.encoding={likely}.")


def _check_scale(name: str, scale_m: float | None, offset: float, where: str) -> float:
    if scale_m is None:
        unit = "metres per stored unit" if name == "linear" else "focal length [pixels] * baseline [m], or 1"
        raise DataError(
            f"{_prefix(where)}data.encoding={name} needs a scale, and there is none. Pass data.depth_scale_m=<{unit}>, "
            "add the column depth_scale_m to the index, or pass another data.encoding."
        )
    if not (np.isfinite(scale_m) and scale_m > 0 and np.isfinite(offset)):
        raise DataError(
            f"{_prefix(where)}depth scale {scale_m} m with offset {offset}. "
            "The scale must be positive and both must be finite."
        )
    return scale_m


def _prefix(where: str) -> str:
    return f"{where}: " if where else ""
