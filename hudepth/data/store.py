"""The depth store: one HDF5 file that holds a prepared data set, whatever its original form.

======================  ===================  ==========================================================
data set                dtype, shape         meaning
======================  ===================  ==========================================================
image                   uint8 [n, h, w, 3]   RGB at training size
depth                   uint16 [n, h, w]     at training size, ``per_metre`` to the metre, 0 where unmeasured
native/png              uint8 [bytes]        ground truth at native resolution: 16-bit PNGs, one after another
native/end              int64 [n]            where each of them ends
records/<field>         [n]                  id, scene, frame, split, category of each pair
======================  ===================  ==========================================================

The attribute ``per_metre`` is one of :data:`SCALES`. The attribute ``info`` is a JSON object with the source's name and
fingerprint, encoding, depth range and skipped files. A file without it was never finished.
"""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import ConfigError, DataError
from hudepth.base.images import MAX_NATIVE_PIXELS
from hudepth.base.options import TrainSize, convert
from hudepth.data.sources.base import Record
from hudepth.data.sources.files import PerProcess
from hudepth.data.sources.hdf5 import RowFile, own_array

FORMAT = "hudepth-depth-store"
VERSION = 2
MM_PER_M = 1000
OUTDOOR_PER_M = 256  # as KITTI
SCALES = (MM_PER_M, *(OUTDOOR_PER_M >> shift for shift in range(9)))
"""Stored values per metre that a store can have: up to 65.535 m, 255.996 m, 511.992 m, ..., 65,535 m."""
MAX_STORED = int(np.iinfo(np.uint16).max)
_AGAIN = "Delete it and prepare again."
_TEXTS = ("id", "scene", "split", "category")


def to_mm(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Round predicted depths [h, w], finite and not negative [m], to millimetres; beyond 65.535 m they are that."""
    return to_stored(np.minimum(depth_m, MAX_STORED / float(MM_PER_M)), MM_PER_M)


def to_stored(depth_m: NDArray[np.float32], per_m: int) -> NDArray[np.uint16]:
    """Round depths [h, w], finite, not negative and at most 65535 / ``per_m`` [m], to the values a store holds.

    0 (unmeasured) stays 0, and a measured depth never becomes 0: below half a step it is stored as one.
    """
    stored: NDArray[np.float32] = np.rint(depth_m * float(per_m))
    return np.maximum(stored, depth_m > 0).astype(np.uint16)


@contextmanager
def _plain_os_errors() -> Iterator[None]:
    """Raise a short OSError: HDF5 describes a full disk in several lines, sometimes as a RuntimeError."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        found = re.search(r"errno = (\d+)", str(error))
        code = int(found[1]) if found else getattr(error, "errno", None) or errno.EIO
        raise OSError(code, os.strerror(code)) from error


class StoreWriter:
    """Writes a depth store pair by pair, over ``path``. Use it inside :func:`hudepth.base.files.written_whole`.

    ``size`` is (height, width) of images and depths; ``native``: whether each pair has ground truth at native
    resolution; ``per_m``: stored depths are so many to the metre. All methods raise OSError if the file cannot be
    written.
    """

    def __init__(self, path: Path, *, size: tuple[int, int], native: bool, per_m: int = MM_PER_M) -> None:
        with _plain_os_errors():
            self._file = h5py.File(path, "w", libver="latest")
            try:
                self._image, self._depth = (
                    self._file.create_dataset(name, (0, *shape), dtype, maxshape=(None, *shape), chunks=(1, *shape))
                    for name, dtype, shape in (("image", "u1", (*size, 3)), ("depth", "u2", size))
                )
                if native:
                    self._png = self._file.create_dataset("native/png", (0,), "u1", maxshape=(None,), chunks=(1 << 20,))
                self._file.flush()  # a file that cannot hold even this is aborted now
            except BaseException:
                self.abort()
                raise
        self._native, self._per_m = native, per_m
        self._ends: list[int] = []
        self._records: list[Record] = []

    def append(
        self,
        record: Record,
        image: NDArray[np.uint8],
        stored_depth: NDArray[np.uint16],
        native_png: NDArray[np.uint8] | None,
    ) -> None:
        """Add one pair at training size, with its native ground truth as an encoded 16-bit PNG.

        Raises ValueError if the pair has native ground truth and the store has none, or vice versa.
        """
        if self._native != (native_png is not None):
            raise ValueError(f"'{record.id}': either all pairs of a store have native ground truth or none.")
        row = len(self._records)
        with _plain_os_errors():
            if row == len(self._image):  # grow by doubling: a resize rewrites the index of chunks
                for dataset in (self._image, self._depth):
                    dataset.resize(max(64, 2 * row), axis=0)
            self._image[row] = image
            self._depth[row] = stored_depth
            if native_png is not None:
                start = self._ends[-1] if self._ends else 0
                self._png.resize(start + len(native_png), axis=0)
                self._png[start:] = native_png
                self._ends.append(start + len(native_png))
        self._records.append(record)

    def close(self, info: dict[str, Any]) -> None:
        """Write the records and ``info``, and close the file."""
        with _plain_os_errors():
            for dataset in (self._image, self._depth):
                dataset.resize(len(self._records), axis=0)
            if self._native:
                self._file["native/end"] = np.array(self._ends, dtype=np.int64)
            for field in _TEXTS:
                values = [getattr(record, field).encode() for record in self._records]
                self._file[f"records/{field}"] = np.array(values, dtype=h5py.string_dtype())
            self._file["records/frame"] = np.array([record.frame for record in self._records], dtype=np.int64)
            self._file.attrs["format"] = FORMAT
            self._file.attrs["version"] = VERSION
            self._file.attrs["per_metre"] = self._per_m
            self._file.attrs["info"] = json.dumps(info)
            self._file.flush()  # a flush that fails can be aborted, a close that fails cannot
            self._file.close()

    def abort(self) -> None:
        """Close the unfinished file."""
        if not self._file:
            return
        # HDF5 cannot discard its buffers, and crashes at exit if it cannot write them: let it write to nowhere.
        nowhere = os.open(os.devnull, os.O_RDWR)
        os.dup2(nowhere, self._file.id.get_vfd_handle())
        os.close(nowhere)
        with suppress(OSError, RuntimeError):  # an interrupted flush still closes the file
            self._file.close()


def _read_layout(file: h5py.File) -> tuple[list[Record], tuple[int, int], bool]:
    """Return records, (height, width) and whether there is native truth; ValueError or the like if a part is amiss."""
    count, *size = own_array(file, "image", "u1", (None, None, None, 3)).shape[:3]
    size = convert("its size", size, TrainSize)
    own_array(file, "depth", "u2", (count, *size))
    columns = [own_array(file, f"records/{field}", "O", (count,)).asstr()[:] for field in _TEXTS]
    frames = own_array(file, "records/frame", "i8", (count,))[:].tolist()
    if "native" in file:
        total = len(own_array(file, "native/png", "u1", (None,)))
        ends = [0, *own_array(file, "native/end", "i8", (count,))[:].tolist(), total + 1]
        if any(after <= before for before, after in pairwise(ends)):
            raise ValueError("the ends of its native truths do not rise")
    if len(set(columns[0])) < count:
        raise ValueError("ids repeat")
    rows = (dict(zip(("frame", *_TEXTS), row, strict=True)) for row in zip(frames, *columns, strict=True))
    return [Record(**row) for row in rows], size, "native" in file


class DepthStore:
    """A depth store, opened for reading. Worker processes can be given it: each opens its own handle on first use.

    Raises DataError if the file is missing, unfinished or of another version.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._handle: PerProcess[h5py.File] = PerProcess(h5py.File)
        self._rows = PerProcess(partial(RowFile, names=("image", "depth")))
        try:
            with h5py.File(self.path, "r") as file:
                if (file.attrs.get("format"), file.attrs.get("version")) != (FORMAT, VERSION):
                    raise DataError(f"'{self.path}' is not a depth store of version {VERSION}. {_AGAIN}")
                self.info: dict[str, Any] = dict(json.loads(file.attrs["info"]))
                self.per_m = int(file.attrs.get("per_metre", MM_PER_M))  #: stored depths are so many to the metre
                self.records, self.size, self.has_native = _read_layout(file)
            if self.per_m not in SCALES:
                raise ValueError(f"per_metre is {self.per_m}")
        except (OSError, RuntimeError, KeyError, TypeError, ValueError, ConfigError) as error:
            fix = _AGAIN
            if "lock file" in str(error):  # a disk over the network that has no locks
                fix = "Set the environment variable HDF5_USE_FILE_LOCKING=FALSE, or pass paths.cache=<a local folder>."
            raise DataError(f"'{self.path}' cannot be read as a depth store ({error}). {fix}") from error

    def __len__(self) -> int:
        return len(self.records)

    def read(self, indices: Sequence[int]) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Read pairs at training size by their positions, in any order, possibly repeated.

        Returns image [n, h, w, 3] RGB, and depth [n, h, w], :attr:`per_m` to the metre, 0 where unmeasured.
        """
        images = np.empty((len(indices), *self.size, 3), np.uint8)
        depths = np.empty((len(indices), *self.size), np.uint16)
        with self._damage():
            rows = self._rows.get(self.path)
            for name, target in (("image", images), ("depth", depths)):
                for place, index in enumerate(indices):
                    rows.read(name, index, target[place])
        return images, depths

    @contextmanager
    def _damage(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError, ValueError, OverflowError) as error:
            raise DataError(f"'{self.path}' is damaged ({error}). {_AGAIN}") from error

    def read_ahead(self, first: int, last: int) -> None:
        """Ask the system to read the pairs from ``first`` to ``last`` in one go, if it takes such hints."""
        with self._damage():
            self._rows.get(self.path).read_ahead(first, last)

    def read_native(self, index: int) -> NDArray[np.float32]:
        """Read one ground truth at its native resolution: [H, W] metres, 0 where unmeasured.

        Raises DataError if the store was prepared without native ground truth, or it is too large.
        """
        if not self.has_native:
            raise DataError(f"'{self.path}' has no native ground truth. Pass data.native=true, or protocol=paper.")
        with self._damage():
            file = self._handle.get(self.path)
            start, end = [0, *file["native/end"][max(0, index - 1) : index + 1].tolist()][-2:]
            png = file["native/png"][start:end]
        stored = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
        where = f"'{self.path}': the ground truth of '{self.records[index].id}'"
        if stored is None or stored.ndim != 2 or stored.dtype != np.uint16:
            raise DataError(f"{where} is damaged. {_AGAIN}")
        if stored.size > MAX_NATIVE_PIXELS:
            raise DataError(f"{where} has over {MAX_NATIVE_PIXELS:,} pixels. Shrink it, or pass protocol=paper.")
        return stored.astype(np.float32) / np.float32(self.per_m)
