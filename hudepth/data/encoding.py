"""How stored depth values become metres, and the check that the result is plausible.

Numpy only, as are the sources: worker processes import this module and must not pay for torch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import ConfigError, DataError, did_you_mean

ENCODINGS = ("auto", "uint16_mm", "uint8_10m", "float_m", "linear", "paper_literal")
"""What ``data.encoding`` can be; :func:`to_metres` says what each means."""

INDOOR_MEDIAN_M = (0.3, 20.0)
"""Median depths [m] an indoor set can have; a wrong unit lands far outside."""

_FULL_SCALE_8BIT_M = 10.0  # DenseDepth's training PNGs: 255 is 10 m
_ADVICE_8BIT = (
    "Use data.encoding=uint8_10m for value/255*10 m, or data.encoding=paper_literal to read it so on purpose."
)


class DepthRange(NamedTuple):
    """What :func:`check_range` measured over the depths it was given."""

    min_m: float
    """Smallest measured depth [m]."""
    median_m: float
    """Median of the measured depths [m]."""
    max_m: float
    """Largest measured depth [m]."""
    valid_fraction: float
    """Share of pixels that are measured, in (0, 1]."""


def check_encoding(encoding: str) -> None:
    """Accept a name from :data:`ENCODINGS`.

    Raises:
        ConfigError: for any other name.
    """
    if encoding not in ENCODINGS:
        raise ConfigError(
            f"data.encoding: no encoding '{encoding}'.{did_you_mean(encoding, ENCODINGS)} "
            f"Choose one of {', '.join(ENCODINGS)}."
        )


def resolve_encoding(
    encoding: str, *, dtype: np.dtype[Any], has_scale: bool, auto_uint8: str | None, where: str = ""
) -> str:
    """Return the encoding that ``auto`` stands for; any other name is returned as it is.

    Args:
        encoding: one of :data:`ENCODINGS`.
        dtype: of the stored values.
        has_scale: whether the record brings a scale of its own; if so, ``auto`` is ``linear``.
        auto_uint8: what 8-bit values mean in this source, None where only the user can know.
        where: names the file in errors.

    Raises:
        ConfigError: if the name is unknown.
        DataError: if the values do not tell their unit.
    """
    check_encoding(encoding)
    if encoding != "auto":
        return encoding
    if has_scale:
        return "linear"
    if dtype.kind == "u" and dtype.itemsize == 2:
        return "uint16_mm"
    if dtype.kind == "f":
        return "float_m"
    if dtype == np.uint8 and auto_uint8:
        return auto_uint8
    choices = "uint8_10m (value/255*10 m) or paper_literal (value/1000 m)" if dtype == np.uint8 else "uint16_mm"
    raise DataError(f"{_at(where)}{dtype} depth does not tell its unit. Pass data.encoding={choices}.")


def to_metres(
    raw: NDArray[np.generic],
    encoding: str,
    *,
    scale_m: float | None = None,
    offset: float = 0.0,
    auto_uint8: str | None = None,
    where: str = "",
) -> NDArray[np.float32]:
    """Convert stored depth values to metres.

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

    Args:
        raw: [H, W] stored values.
        encoding: one of :data:`ENCODINGS`.
        scale_m: metres a unit of the stored value, for ``linear``.
        offset: in units of the stored value, for ``linear``.
        auto_uint8: what 8-bit values mean under ``auto``; None where only the user can know.
        where: names the file in errors.

    Returns:
        [H, W] float32 depth [m], 0 where unmeasured.

    Raises:
        ConfigError: if the encoding is unknown.
        DataError: if the values cannot be meant by the encoding, or ``linear`` has no usable scale.
    """
    if raw.ndim != 2:
        raise DataError(f"{_at(where)}depth has shape {raw.shape}. Store one value per pixel, as [H, W].")
    name = resolve_encoding(
        encoding, dtype=raw.dtype, has_scale=scale_m is not None, auto_uint8=auto_uint8, where=where
    )
    _check_values(raw, name, where)
    values = raw.astype(np.float64)  # float64: one rounding, at the end
    if name == "linear":
        values = (values + offset) * _checked_scale(scale_m, offset, where)
    else:
        values = _TO_METRES[name](values)
    with np.errstate(over="ignore", invalid="ignore"):
        metres = values.astype(np.float32)
        metres[~(np.isfinite(metres) & (metres > 0))] = 0.0
    return metres


def check_range(depths: Sequence[NDArray[np.float32]], *, indoor: bool, encoding: str, name: str) -> DepthRange:
    """Measure the range of some depths of a set, and refuse an indoor set whose median no room has.

    Args:
        depths: [H, W] arrays [m], 0 where unmeasured: a sample of the set.
        indoor: whether the set shows rooms.
        encoding: the set's encoding; ``paper_literal`` is let through, it is implausible on purpose.
        name: of the set, for errors.

    Raises:
        DataError: if nothing is measured, or the median is outside :data:`INDOOR_MEDIAN_M`.
    """
    measured = np.concatenate([depth[depth > 0] for depth in depths] or [np.zeros(0, np.float32)])
    if measured.size == 0:
        raise DataError(
            f"data.encoding={encoding}: no pixel of '{name}' is measured in {len(depths)} depth maps. "
            f"Check data.root, or pass another data.encoding ({_others(encoding)})."
        )
    found = DepthRange(
        min_m=float(measured.min()),
        median_m=float(np.median(measured)),
        max_m=float(measured.max()),
        valid_fraction=measured.size / sum(depth.size for depth in depths),
    )
    low, high = INDOOR_MEDIAN_M
    if indoor and encoding != "paper_literal" and not low <= found.median_m <= high:
        raise DataError(
            f"data.encoding={encoding}: '{name}' has a median depth of {found.median_m:.3g} m, "
            f"indoor sets lie in {low:g} to {high:g} m. "
            f"Pass another data.encoding ({_others(encoding)}); "
            "folders and manifests that are not indoors take data.source.indoor=false."
        )
    return found


_TO_METRES: Mapping[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "uint16_mm": lambda values: values / 1000,
    "uint8_10m": lambda values: values / 255 * _FULL_SCALE_8BIT_M,
    "float_m": lambda values: values,
    "paper_literal": lambda values: values / 1000,
}


def _check_values(raw: NDArray[np.generic], name: str, where: str) -> None:
    integer, bits = raw.dtype.kind in "ui", raw.dtype.itemsize * 8
    if raw.dtype.kind not in "uif":
        raise DataError(f"{_at(where)}depth values of type {raw.dtype} are no numbers. Store integers or floats.")
    if name == "uint16_mm" and integer and bits == 8:
        largest = int(raw.max(initial=0))
        raise DataError(
            f"{_at(where)}8-bit data declared as millimetres "
            f"(largest value {largest} = {largest / 1000:g} m). {_ADVICE_8BIT}"
        )
    fits = {
        "uint16_mm": integer,
        "uint8_10m": raw.dtype == np.uint8,
        "float_m": raw.dtype.kind == "f",
        "paper_literal": integer,
    }
    if not fits.get(name, True):
        likely = "float_m" if not integer else "uint8_10m" if raw.dtype == np.uint8 else "uint16_mm"
        raise DataError(f"{_at(where)}{raw.dtype} data declared as {name}. Use data.encoding={likely}.")


def _checked_scale(scale_m: float | None, offset: float, where: str) -> float:
    if scale_m is None:
        raise DataError(
            f"{_at(where)}data.encoding=linear needs a scale for each image, and there is none. "
            "Add the column depth_scale_m to the index, or pass another data.encoding."
        )
    if not (np.isfinite(scale_m) and scale_m > 0 and np.isfinite(offset)):
        raise DataError(
            f"{_at(where)}depth scale {scale_m} m with offset {offset}. "
            "The scale must be positive and both must be finite."
        )
    return scale_m


def _others(encoding: str) -> str:
    return ", ".join(other for other in ENCODINGS if other not in (encoding, "auto"))


def _at(where: str) -> str:
    return f"{where}: " if where else ""
