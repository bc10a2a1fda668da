"""Rows read without HDF5: against h5py's own reading, and what is not laid out for it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from hudepth.data.sources import hdf5
from hudepth.data.sources.hdf5 import RowFile

IMAGES = np.random.default_rng(0).integers(0, 256, (5, 4, 6, 3), np.uint8)
DEPTHS = np.random.default_rng(1).integers(0, 65536, (5, 4, 6), np.uint16)


def write(path: Path, **how: Any) -> Path:
    with h5py.File(path, "w", libver="latest") as file:
        for name, values in (("image", IMAGES), ("depth", DEPTHS)):
            file.create_dataset(name, data=values, **{"chunks": (1, *values.shape[1:]), **how})
    return path


def rows_of(path: Path, name: str, like: NDArray[Any]) -> NDArray[Any]:
    rows, found = RowFile(path, ["image", "depth"]), np.zeros_like(like)
    for row in (3, 0, 4, 1, 2):
        rows.read(name, row, found[row])
    return found


@pytest.mark.parametrize("preadv", [True, False], ids=["preadv", "seek"])
def test_rows_are_those_that_h5py_reads(tmp_path: Path, preadv: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not preadv:
        monkeypatch.delattr(hdf5.os, "preadv", raising=False)
    path = write(tmp_path / "a.h5")
    np.testing.assert_array_equal(rows_of(path, "image", IMAGES), IMAGES)
    np.testing.assert_array_equal(rows_of(path, "depth", DEPTHS), DEPTHS)


@pytest.mark.parametrize(
    "how", [{"compression": "gzip"}, {"shuffle": True}, {"fletcher32": True}, {"chunks": None}, {"chunks": True}]
)
def test_arrays_of_another_layout_are_refused(tmp_path: Path, how: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="'/image' is not stored row by row"):
        RowFile(write(tmp_path / "a.h5", **how), ["image"])


def test_rows_that_were_never_written_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        file.create_dataset("image", (5, 4), "u1", chunks=(1, 4))[1] = 7
    with pytest.raises(ValueError, match="'/image' is not stored row by row"):
        RowFile(tmp_path / "a.h5", ["image"])


def test_a_file_cut_short_while_it_is_open(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5")
    rows = RowFile(path, ["image"])
    os.truncate(path, 64)
    with pytest.raises(OSError, match="ends too early"):
        rows.read("image", 4, np.empty_like(IMAGES[4]))


@pytest.mark.skipif(not hasattr(os, "posix_fadvise"), reason="this system takes no hints")
def test_hints_cover_the_rows_of_both_arrays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, told = RowFile(write(tmp_path / "a.h5"), ["image", "depth"]), []
    monkeypatch.setattr(hdf5.os, "posix_fadvise", lambda _, start, length, advice: told.append((start, length)))
    rows.read_ahead(1, 3)
    for (start, length), name in zip(told, ("image", "depth"), strict=True):
        assert all(start <= place < start + length for place in rows._starts[name][1:4])
        assert not start <= rows._starts[name][0] < start + length
