"""Arrays of HDF5 files that somebody else may have written."""

from __future__ import annotations

import h5py
import numpy as np

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
