"""The official labelled NYU Depth V2 file, read in place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import h5py
import numpy as np

from hudepth.base.errors import DataError
from hudepth.base.images import check_pixels
from hudepth.base.options import Choice
from hudepth.data.encoding import Encoding
from hudepth.data.sources import nyu
from hudepth.data.sources.base import Download, EncodedSource, RawPair, Record, existing_root
from hudepth.data.sources.files import PerProcess, make_pair
from hudepth.data.sources.hdf5 import own_array

_FILE = "nyu_depth_v2_labeled.mat"
_MAX_NAME = 256


@dataclass(eq=False)
class NyuMatSource(nyu.Nyu, EncodedSource):
    """``nyu_depth_v2_labeled.mat`` as the authors publish it: 1449 pairs of 640 x 480 from 464 scenes.

    An HDF5 file with MATLAB's header (Silberman, Hoiem, Kohli and Fergus, ECCV 2012). All arrays are
    transposed: ``images`` [N, 3, W, H] uint8, ``depths`` (in-painted) and ``rawDepths`` (0 where the sensor
    measured nothing) [N, W, H] float32 metres, ``scenes`` [1, N] references to names. The official split, 795
    training and 654 test pairs, is known; a file with another number of pairs has none. ``root`` is the file, or the
    folder that holds it.
    """

    name: ClassVar[str] = "nyu_mat"
    download: ClassVar[Download | None] = Download(
        url=f"http://horatio.cs.nyu.edu/mit/silberman/nyu_depth_v2/{_FILE}",
        file=_FILE,
        size=2_972_037_809,
        md5="520609c519fba3ba5ac58c8fefcc3530",
    )

    root: str | Path | None
    _: KW_ONLY
    depth: Annotated[str, Choice(("depths", "rawDepths"))] = "depths"
    encoding: Encoding = "float_m"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._handle = PerProcess(_open)

    def records(self) -> Sequence[Record]:
        """List the pairs in the file's order; ids count from 00000. See :meth:`Source.records`."""
        path = self._path()
        images, _ = self._arrays(path)
        test = nyu.official_test() if len(images) == nyu.COUNT else None
        frames: dict[str, int] = {}
        records = []
        for index, scene in enumerate(_scenes(self._handle.get(path), images, path)):
            frames[scene] = frames.get(scene, -1) + 1
            name, split = f"{index:05d}", "" if test is None else "test" if index in test else "train"
            record = Record(
                name,
                scene,
                frames[scene],
                split=split,
                category=nyu.category_of(scene),
                image=f"images/{name}",
                depth=f"{self.depth}/{name}",
            )
            records.append(record)
        return records

    def read(self, record: Record) -> RawPair:
        """Read one pair, turned upright; see :meth:`Source.read`."""
        path = self._path()
        index = int(record.id)
        images, depths = self._arrays(path)
        where = f"'{path}' image {index}"
        if not index < min(len(images), len(depths)):
            raise DataError(f"{where}: the file holds {len(images)} images and {len(depths)} depth maps.")
        try:
            image = np.ascontiguousarray(images[index].transpose(2, 1, 0))
            depth = np.ascontiguousarray(depths[index].T)
        except (OSError, RuntimeError):
            raise DataError(f"{where}: cannot be read, the file is damaged. Copy the file again.") from None
        return make_pair(image, depth, image_where=where, depth_where=f"its {self.depth}")

    def files(self) -> Sequence[Path]:
        """Return the file."""
        return [self._path()]

    def _path(self) -> Path:
        root = existing_root(self.root, expects=f"path of {_FILE}")
        path = root / _FILE if root.is_dir() else root
        if not path.is_file():
            raise DataError(
                f"data.root: no file '{_FILE}' in '{root}'. Pass data.root=<path of {_FILE}>, or run with data=rooms."
            )
        return path

    def _arrays(self, path: Path) -> tuple[h5py.Dataset, h5py.Dataset]:
        file = self._handle.get(path)
        images = _dataset(file, "images", "u1", (None, 3, None, None), path)
        return images, _dataset(file, self.depth, "f", (None, None, None), path)


def _open(path: Path) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except OSError:
        raise DataError(f"'{path}': not an HDF5 file, or truncated. Copy the file again.") from None


def _dataset(file: h5py.File, name: str, kind: str, shape: tuple[int | None, ...], path: Path) -> h5py.Dataset:
    try:
        found = own_array(file, name, kind, shape)
    except ValueError as error:
        fix = "Repack the file." if "chunks" in str(error) else f"Pass data.root=<path of {_FILE}>."
        raise DataError(f"'{path}': {error}. {fix}") from None
    check_pixels(found.shape[-1], found.shape[-2], where=f"'{path}' {name}")
    return found


def _scenes(file: h5py.File, images: h5py.Dataset, path: Path) -> list[str]:
    table: Any = file.get("scenes") if isinstance(file.get("scenes", getlink=True), h5py.HardLink) else None
    count = len(images)
    known = isinstance(table, h5py.Dataset) and h5py.check_ref_dtype(table.dtype) is h5py.Reference
    if not known or table.size != count:
        raise DataError(f"'{path}': no {count} scene names in 'scenes'. Pass data.root=<path of {_FILE}>.")
    return [_text(file, reference, path) for reference in table[()].ravel()]


def _text(file: h5py.File, reference: Any, path: Path) -> str:
    try:
        name = file[reference]
    except (ValueError, KeyError):
        name = None
    if not isinstance(name, h5py.Dataset) or name.dtype.kind != "u" or name.size > _MAX_NAME:
        raise DataError(f"'{path}': a scene has no name. Copy the file again.")
    return "".join(map(chr, name[()].ravel().tolist()))
