"""Pictures without ground truth that join the training pairs: a student learns from a teacher's depths of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from hudepth.base.console import log, track
from hudepth.base.errors import DataError
from hudepth.base.files import name_results, written_whole
from hudepth.base.images import resize_image
from hudepth.data.audit.duplicates import NEAR_BITS, find_nearest_hashes, hash_images
from hudepth.data.distill.teacher import find_depths, read_teacher
from hudepth.data.prepare import build_once
from hudepth.data.sources.contents import hash_contents
from hudepth.data.sources.decoding import read_image
from hudepth.data.sources.files import IMAGE_SUFFIXES, PerProcess
from hudepth.data.sources.hdf5 import RowFile
from hudepth.data.splits import Split
from hudepth.data.store import DepthStore

_AT_ONCE = 64


class Pictures:
    """Pictures of a folder and its subfolders, each with a teacher's depth, prepared once at the training size.

    Args:
        folder: JPEG and PNG files. A picture's id is the name that ``hudepth-predict`` gives its results, which is its
            path in the folder without the suffix, unless two differ in that alone.
        teacher: folder of a depth for each id, as for :class:`hudepth.data.distill.teacher.TeacherDepths`.
        store: the depth store of the training pairs.
        split: of the store. The images of its validation and test pairs may not be among the pictures.

    Raises DataError if there are none, one cannot be read, one has the id of a training pair or no depth of its size,
    or one is a duplicate of an image that is held out, exact or near, by perceptual hash.
    """

    def __init__(self, folder: str | Path, teacher: str | Path, store: DepthStore, split: Split) -> None:
        root = Path(folder).expanduser()
        if not root.is_dir():
            raise DataError(
                f"distill.pictures: no folder '{root}'. Pass distill.pictures=<folder of JPEG or PNG files>."
            )
        taught = Path(teacher).expanduser()
        files = _find_pictures(root, taught)
        self.ids = [stem.as_posix() for stem in name_results(files, root).values()]
        if both := sorted({*self.ids} & {store.records[index].id for index in split.train}):
            raise DataError(
                f"distill.pictures: {len(both)} pictures have the name of a training pair, the first is '{both[0]}', "
                f"so both would have one depth in '{taught}'. Move the pictures into a subfolder of '{root}', and "
                "predict them with recursive=true."
            )
        self.size = store.size
        depths = find_depths(taught, self.ids, what="pictures")
        cache = store.path.parent
        key = [hash_contents("pictures", [*files, *depths], cache=cache), self.size]
        self.path = cache / f"pictures-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.h5"
        build_once(self.path, partial(_prepare, files, depths, self.size))
        self._rows = PerProcess(partial(RowFile, names=("image", "depth")))
        self._refuse_copies(store, [*split.val, *split.test], files)

    def __len__(self) -> int:
        return len(self.ids)

    def read(self, indices: Sequence[int]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Read images [n, h, w, 3] and the teacher's depths [n, h, w], 0 where there is none."""
        images = np.empty((len(indices), *self.size, 3), np.uint8)
        depths = np.empty((len(indices), *self.size), np.float32)
        rows = self._rows.get(self.path)
        for place, index in enumerate(indices):
            rows.read("image", index, images[place])
            rows.read("depth", index, depths[place])
        return images, depths

    def _refuse_copies(self, store: DepthStore, theirs: Sequence[int], files: Sequence[Path]) -> None:
        ours = range(len(self))
        if not theirs:
            return
        hashes = [hash_images(self.read(ours[i : i + _AT_ONCE])[0]) for i in ours[::_AT_ONCE]]
        known = [hash_images(store.read(theirs[i : i + _AT_ONCE])[0]) for i in range(0, len(theirs), _AT_ONCE)]
        nearest, bits = find_nearest_hashes(np.concatenate(hashes), np.concatenate(known))
        copies = np.flatnonzero(bits <= NEAR_BITS)
        if copies.size:
            first = copies[0]
            raise DataError(
                f"distill.pictures: {copies.size} of {len(self)} pictures show images that are held out, the first is "
                f"'{files[first]}', like '{store.records[theirs[nearest[first]]].id}'. Leave them out."
            )


def _find_pictures(root: Path, teacher: Path) -> list[Path]:
    """Return the JPEG and PNG files of a folder, but no hidden ones and none of the teacher's; count the others."""
    taught = teacher.resolve()
    there = [path for path in sorted(root.rglob("[!.]*")) if path.is_file() and taught not in path.resolve().parents]
    others = [path.name for path in there if path.suffix.lower() not in IMAGE_SUFFIXES]
    files = [path for path in there if path.suffix.lower() in IMAGE_SUFFIXES]
    if not files:
        raise DataError(f"distill.pictures: no JPEG or PNG file in '{root}'.")
    if others:
        log.info("distill.pictures: left out, neither JPEG nor PNG: %d (%s)", len(others), ", ".join(others[:5]))
    return files


def _prepare(files: Sequence[Path], depths: Sequence[Path], size: tuple[int, int], path: Path) -> None:
    height, width = size
    with written_whole(path) as part, h5py.File(part, "w", libver="latest") as out:
        images = out.create_dataset("image", (len(files), *size, 3), "u1", chunks=(1, *size, 3))
        teacher = out.create_dataset("depth", (len(files), *size), "f4", chunks=(1, *size))
        pairs = zip(files, depths, strict=True)
        for row, (file, depth_file) in enumerate(track(pairs, total=len(files), what="preparing pictures")):
            image, depth = read_image(file, upright=True), read_teacher(depth_file)
            if depth.shape != image.shape[:2]:
                raise DataError(
                    f"distill.teacher: '{depth_file}' is {depth.shape[0]} x {depth.shape[1]}, but its picture is "
                    f"{image.shape[0]} x {image.shape[1]} (height x width). Predict it again."
                )
            images[row] = resize_image(image, size)
            teacher[row] = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
