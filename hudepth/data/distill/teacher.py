"""A teacher's depths of the training images, read alongside the ground truth: the targets of distillation."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from hudepth.base.console import track
from hudepth.base.errors import DataError
from hudepth.base.files import written_whole
from hudepth.data.prepare import MAX_SIZES, build_once
from hudepth.data.sources.contents import hash_contents
from hudepth.data.sources.decoding import read_depth
from hudepth.data.sources.files import PerProcess
from hudepth.data.sources.hdf5 import RowFile
from hudepth.data.store import DepthStore

ENDINGS = (".npy", ".png", "_depth.npy", "_depth.png")
"""What follows a pair's id in the name of its teacher's depth; the last two are what ``hudepth-predict`` writes."""


class TeacherDepths:
    """A teacher's depths at the training size, prepared once from a folder of files.

    A ``.npy`` holds floats: metres, or any unit if the loss is affine-invariant; a ``.png`` 16-bit millimetres.
    Values that are not finite or not positive count as missing. Raises DataError if depths are missing, cannot be
    read, or are not of their images' size.

    ``folder`` has a file for each training pair: its id, then one of :data:`ENDINGS`; ``indices`` are the positions of
    these pairs in the store.
    """

    def __init__(self, folder: str | Path, store: DepthStore, indices: Sequence[int]) -> None:
        root = Path(folder).expanduser()
        if not root.is_dir():
            raise DataError(f"distill.teacher: no folder '{root}'. Pass distill.teacher=<folder of npy or png files>.")
        rows = sorted(indices)
        records = [store.records[index] for index in rows]
        files = find_depths(root, [record.id for record in records], what="training pairs")
        self._position = {index: position for position, index in enumerate(rows)}
        self.size = store.size
        key = [store.path.name, hash_contents("teacher", files, cache=store.path.parent), rows]
        self.path = store.path.with_name(f"teacher-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.h5")
        build_once(self.path, partial(_prepare, files, store))
        self._rows = PerProcess(partial(RowFile, names=("depth",)))

    def read(self, indices: Sequence[int]) -> NDArray[np.float32]:
        """Read the depths at positions in the depth store: [n, h, w], 0 where there is none."""
        depths = np.empty((len(indices), *self.size), np.float32)
        rows = self._rows.get(self.path)
        for place, index in enumerate(indices):
            rows.read("depth", self._position[index], depths[place])
        return depths


def find_depths(root: Path, ids: Sequence[str], *, what: str) -> list[Path]:
    """Return the file of each id; DataError if one has none, which says ``what`` the ids name."""
    candidates = ([root / f"{each}{ending}" for ending in ENDINGS] for each in ids)
    files = [next(filter(Path.is_file, paths), None) for paths in candidates]
    if missing := [each for each, file in zip(ids, files, strict=True) if file is None]:
        raise DataError(
            f"distill.teacher: {len(missing)} of {len(ids)} {what} have no depth in '{root}', the first is "
            f"'{missing[0]}': no {missing[0]}.npy or .png. Predict them with hudepth-predict, or copy them there."
        )
    return [file for file in files if file]


def _prepare(files: Sequence[Path], store: DepthStore, path: Path) -> None:
    native = {tuple(size) for size in store.info.get("native_sizes") or []} | {tuple(store.size)}
    height, width = store.size
    with written_whole(path) as part, h5py.File(part, "w", libver="latest") as out:
        depths = out.create_dataset("depth", (len(files), height, width), "f4", chunks=(1, height, width))
        for row, file in enumerate(track(files, total=len(files), what="reading the teacher's depths")):
            depth = read_teacher(file)
            if depth.shape not in native and len(native) < MAX_SIZES:  # else the store names some of them only
                sizes = " or ".join(f"{h} x {w}" for h, w in sorted(native, reverse=True)[:3])
                raise DataError(
                    f"distill.teacher: '{file}' is {depth.shape[0]} x {depth.shape[1]}, but the images are {sizes} "
                    "(height x width). Resize it to its image."
                )
            depths[row] = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)


def read_teacher(file: Path) -> NDArray[np.float32]:
    """Read a depth map [H, W], 0 where it is not finite or not positive; DataError if the file is none."""
    try:
        depth = read_depth(file)
    except DataError:
        depth = np.empty(0)
    wanted = "fiu" if file.suffix == ".npy" else "u"
    if depth.ndim != 2 or depth.dtype.kind not in wanted or (file.suffix == ".png" and depth.dtype.itemsize != 2):
        raise DataError(
            f"distill.teacher: '{file}' is not a depth map: a .npy of numbers [height, width], "
            "or a 16-bit grey .png [mm]."
        )
    values = depth.astype(np.float32) / np.float32(1 if file.suffix == ".npy" else 1000)
    return np.where(np.isfinite(values) & (values > 0), values, np.float32(0))
