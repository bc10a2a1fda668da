"""Depth maps kept as plain arrays: ``.npy`` and PFM."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.base.images import check_file, check_pixels

_PFM = re.compile(rb"Pf\s(\d{1,6})\s+(\d{1,6})\s+([-+.\deE]{1,20})[ \t\r]*\n")


def read_npy(path: Path, where: str, *, kinds: str = "uif") -> NDArray[np.generic]:
    """Read an array of [H, W], [1, H, W] or [H, W, 1] numbers of some of numpy's ``kinds``.

    Raises DataError if it is none, or too large.
    """
    check_file(path)
    try:  # open_memmap reads the header alone, refuses pickles, and finds files that are cut short
        mapped = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # numpy hands the header to Python's parser, which has many ways to fail
        if "Python objects" in str(error):
            raise DataError(f"{where}: holds Python objects. Save the depth array inside with numpy.save.") from None
        raise DataError(f"{where}: not a complete .npy array of plain numbers. Save it with numpy.save.") from None
    shape = mapped.shape
    if mapped.ndim == 3 and 1 in (shape[0], shape[2]):
        shape = shape[1:] if shape[0] == 1 else shape[:2]
    if len(shape) != 2 or mapped.dtype.kind not in kinds:
        what = "a mask" if mapped.dtype.kind == "b" else f"{mapped.dtype} array of shape {mapped.shape}"
        raise DataError(f"{where}: {what}. Save one number per pixel, as [H, W].")
    check_pixels(*shape, where=where)
    return np.array(mapped, dtype=mapped.dtype.newbyteorder("="), order="C", subok=False).reshape(shape)


def read_pfm(data: bytes, where: str) -> NDArray[np.float32]:
    """Decode a grey PFM: a text header, then rows of floats from the lowest up; DataError if it is none."""
    header = _PFM.match(data)
    if header is None:
        raise DataError(f"{where}: not a PFM of one channel. Save its depth as .npy.")
    width, height = int(header[1]), int(header[2])
    check_pixels(height, width, where=where)
    order = "<" if header[3].startswith(b"-") else ">"  # the sign of the scale
    if len(data) - header.end() < 4 * width * height:
        raise DataError(f"{where}: the PFM is truncated. Copy the file again.")
    rows = np.frombuffer(data, f"{order}f4", width * height, header.end()).reshape(height, width)
    return np.ascontiguousarray(rows[::-1], np.float32)
