"""A small reader for numeric matrices in MATLAB 5 files, which is what NYU's ``splits.mat`` is.

It follows "MAT-File Format" (The MathWorks, R2006b and later), chapter 1, level 5; h5py cannot open these
files. Structures, cells, text, sparse and complex matrices are stepped over: nothing in a file is ever
executed.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError

MAX_BYTES = 64 << 20
"""Larger contents, after decompression, are refused."""

_INT32, _MATRIX, _COMPRESSED = 5, 14, 15
_COMPLEX_FLAG = 0x0800
_STORED_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"
}  # fmt: skip


def read_mat5(data: bytes, *, where: str) -> dict[str, NDArray[np.generic]]:
    """Return the real numeric matrices of a MATLAB 5 file by name.

    Args:
        data: the whole file.
        where: names the file in errors.

    Returns:
        Arrays with MATLAB's shape and class; other kinds of variables are left out.

    Raises:
        DataError: if it is no MATLAB 5 file, truncated, damaged, or holds more than :data:`MAX_BYTES`.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if not data.startswith(b"MATLAB 5.0") or order is None:
        raise DataError(f"{where}: not a MATLAB 5 file. Save it with save('-v6') or save('-v7').")
    found: dict[str, NDArray[np.generic]] = {}
    budget = MAX_BYTES
    try:
        for kind, body in _elements(data[128:], order):
            if kind == _COMPRESSED:
                inner = _inflate(body, budget, where)
                budget -= len(inner)
                variables = list(_elements(inner, order))
            else:
                variables = [(kind, body)]
            found |= dict(_matrix(part, order) for kind, part in variables if kind == _MATRIX and part)
    except (struct.error, zlib.error, ValueError, IndexError, UnicodeDecodeError):
        raise DataError(f"{where}: the MATLAB 5 file is truncated or damaged. Copy the file again.") from None
    found.pop("", None)  # what was stepped over
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield (type, body) of each element: 8 bytes of tag, then the body, padded to 8 unless compressed."""
    at = 0
    while at < len(data):
        (kind,) = struct.unpack_from(f"{order}I", data, at)
        if kind >> 16:  # small element: type and length share 4 bytes, the body has the other 4
            size, kind, start, step = kind >> 16, kind & 0xFFFF, at + 4, 8
        else:
            (size,) = struct.unpack_from(f"{order}I", data, at + 4)
            start, step = at + 8, 8 + size + (0 if kind == _COMPRESSED else -size % 8)
        if start + size > len(data):
            raise ValueError("an element ends beyond the data")
        yield kind, data[start : start + size]
        at += step


def _matrix(body: bytes, order: str) -> tuple[str, NDArray[np.generic]]:
    """Decode one miMATRIX; the name is empty if it is not a real numeric one."""
    parts = _elements(body, order)
    (flags,) = struct.unpack_from(f"{order}I", _next(parts)[1])
    kind, dims = _next(parts)
    if kind != _INT32:
        raise ValueError("a matrix without dimensions")
    shape = tuple(int(size) for size in np.frombuffer(dims, f"{order}i4"))
    name = _next(parts)[1].decode("ascii")
    class_name = _CLASSES.get(flags & 0xFF)
    if class_name is None or flags & _COMPLEX_FLAG:
        return "", np.zeros(0)
    kind, values = _next(parts)
    if kind not in _STORED_TYPES:
        raise ValueError("an unknown number format")
    stored = np.frombuffer(values, f"{order}{_STORED_TYPES[kind]}")
    if min(shape, default=-1) < 0 or math.prod(shape) != stored.size:
        raise ValueError("a matrix whose dimensions do not fit its values")
    return name, stored.astype(class_name).reshape(shape, order="F")  # small integers are stored narrower


def _next(parts: Iterator[tuple[int, bytes]]) -> tuple[int, bytes]:
    part = next(parts, None)
    if part is None:
        raise ValueError("a matrix that lacks a part")
    return part


def _inflate(body: bytes, limit: int, where: str) -> bytes:
    stream = zlib.decompressobj()
    inner = stream.decompress(body, limit + 1)
    if len(inner) > limit:
        raise DataError(f"{where}: holds more than {MAX_BYTES >> 20} MiB. It cannot be a list of splits.")
    if not stream.eof:
        raise ValueError("a compressed element that does not end")
    return inner
