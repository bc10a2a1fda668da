"""Arrays of HDF5 files that somebody else may have written."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hudepth.base.images import MAX_PIXELS


def own_array(file: h5py.File, name: str, kind: str, shape: tuple[int | None, ...]) -> h5py.Dataset:
    """Return an array of this file, not of one that it links to.

    Args:
        file: the open file.
        name: path of the array.
        kind: how its type begins: ``u1``, or ``f`` for any floating point.
        shape: its length along each axis; None for any.

    Raises:
        ValueError: if there is none, or its type, its shape or the size of its chunks is another.
    """
    link = file.get(name, getlink=True)
    found = file.get(name) if isinstance(link, h5py.HardLink) else None
    if not isinstance(found, h5py.Dataset) or found.external or found.is_virtual:
        raise ValueError(f"no array '{name}'")
    fits = found.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, found.shape, strict=True))
    if not fits or not found.dtype.str[1:].startswith(kind):
        raise ValueError(f"'{name}' is {found.dtype} of shape {found.shape}")
    if found.chunks and np.prod(found.chunks, dtype=float) > 3 * MAX_PIXELS:  # a chunk is decompressed as a whole
        raise ValueError(f"'{name}' has chunks of {found.chunks} values")
    return found


class RowFile:
    """Rows of uncompressed arrays, each a chunk of its own, read straight from the file: HDF5 is several times slower.

    Args:
        path: an HDF5 file.
        names: arrays in it.

    Raises:
        ValueError: if an array is laid out in another way.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        with h5py.File(path, "r") as file:
            self._starts = {name: _row_starts(file[name]) for name in names}
        self._file = path.open("rb", buffering=0)

    def read(self, name: str, row: int, target: NDArray[Any]) -> None:
        """Read a row of an array into contiguous memory of its size; OSError if the file ends before it does."""
        start, memory = int(self._starts[name][row]), target.data.cast("B")
        if hasattr(os, "preadv"):
            count = os.preadv(self._file.fileno(), [memory], start)
        else:  # Windows
            self._file.seek(start)
            count = self._file.readinto(memory) or 0
        if count != len(memory):
            raise OSError(errno.EIO, "it ends too early")

    def read_ahead(self, first: int, last: int) -> None:
        """Ask the system to read the rows from ``first`` to ``last`` in one go, if it takes such hints."""
        if hasattr(os, "posix_fadvise"):
            for starts in self._starts.values():
                start, end = int(starts[first : last + 1].min()), int(starts[first : last + 1].max())
                os.posix_fadvise(self._file.fileno(), start, end - start + 1, os.POSIX_FADV_WILLNEED)


def _row_starts(array: h5py.Dataset) -> NDArray[np.int64]:
    """Return where each row of an array begins in the file [bytes]."""
    starts = np.full(len(array), -1)

    def note(chunk: h5py.h5d.StoreInfo) -> None:
        if chunk.filter_mask == 0 and chunk.size == array.dtype.itemsize * np.prod(array.shape[1:], dtype=np.int64):
            starts[chunk.chunk_offset[0]] = chunk.byte_offset

    plain = array.dtype.isnative and array.id.get_create_plist().get_nfilters() == 0
    if plain and array.chunks == (1, *array.shape[1:]):
        array.id.chunk_iter(note)
    if (starts < 0).any():
        raise ValueError(f"'{array.name}' is not stored row by row")
    return starts
