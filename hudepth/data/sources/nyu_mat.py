"""The official labelled NYU Depth V2 file, read in place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from hudepth.base.errors import ConfigError, DataError, did_you_mean
from hudepth.base.images import MAX_PIXELS, check_pixels, read_bytes
from hudepth.data.encoding import check_encoding
from hudepth.data.sources.base import RawPair, Record, Source, existing_root
from hudepth.data.sources.files import PerProcess, make_pair
from hudepth.data.sources.mat5 import read_mat5
from hudepth.data.sources.pairing import category_of

_FILE = "nyu_depth_v2_labeled.mat"
_SPLITS = "splits.mat"
_DEPTHS = ("depths", "rawDepths")
_MAX_NAME = 256


class NyuMatSource(Source):
    """``nyu_depth_v2_labeled.mat`` as the authors publish it: 1449 pairs of 640 x 480 from 464 scenes.

    An HDF5 file with MATLAB's header (Silberman, Hoiem, Kohli and Fergus, ECCV 2012). All arrays are
    transposed: ``images`` [N, 3, W, H] uint8, ``depths`` (in-painted) and ``rawDepths`` (0 where the sensor
    saw nothing) [N, W, H] float32 metres, ``scenes`` [1, N] references to names. The official split is in a
    second file, ``splits.mat``.

    Args:
        root: the file, or the folder that holds it.
        depth: ``depths`` or ``rawDepths``.
        encoding: how depth values become metres.
        splits: path of ``splits.mat``; by default the one beside the data, and no split if there is none.
    """

    name: ClassVar[str] = "nyu_mat"

    def __init__(
        self,
        root: str | Path | None,
        *,
        depth: str = "depths",
        encoding: str = "float_m",
        splits: str | Path | None = None,
    ) -> None:
        self.root = root
        self.depth = depth
        self.encoding = encoding
        self.splits = splits
        self._handle = PerProcess(_open)

    def records(self) -> Sequence[Record]:
        """List the pairs in the file's order; ids count from 00000.

        Raises:
            ConfigError: if an option is unknown.
            DataError: if the file is missing or is not laid out as above, or the split does not fit it.
        """
        check_encoding(self.encoding)
        path = self._path()
        self._depths(path)
        scenes = _scenes(self._handle.get(path), self._images(path), path)
        splits = self._splits(path, len(scenes))
        seen: dict[str, int] = {}
        records = []
        for index, (scene, split) in enumerate(zip(scenes, splits, strict=True)):
            seen[scene] = seen.get(scene, -1) + 1
            category = category_of(scene)
            records.append(
                Record(
                    id=f"{index:05d}",
                    scene=scene,
                    frame=seen[scene],
                    split=split,
                    category=category,
                    image=f"images/{index:05d}",
                    depth=f"{self.depth}/{index:05d}",
                )
            )
        return records

    def read(self, record: Record) -> RawPair:
        """Read one pair, turned upright.

        Raises:
            DataError: if the file is missing or damaged.
        """
        path = self._path()
        index = int(record.id)
        images, depths = self._images(path), self._depths(path)
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
        """Return the data file, and the split if there is one.

        Raises:
            DataError: if the data file is missing, or a split that was asked for.
        """
        path = self._path()
        splits = self._splits_path(path)
        return [path] if splits is None else [path, splits]

    def _path(self) -> Path:
        root = existing_root(self.root, expects=f"path of {_FILE}")
        path = root / _FILE if root.is_dir() else root
        if not path.is_file():
            raise DataError(
                f"data.root: no file '{_FILE}' in '{root}'. Pass data.root=<path of {_FILE}>, or run with data=rooms."
            )
        return path

    def _images(self, path: Path) -> h5py.Dataset:
        return _dataset(self._handle.get(path), "images", "u1", ndim=4, path=path)

    def _depths(self, path: Path) -> h5py.Dataset:
        if self.depth not in _DEPTHS:
            raise ConfigError(
                f"data.source.depth: no depth '{self.depth}'.{did_you_mean(self.depth, _DEPTHS)} "
                f"Choose one of {', '.join(_DEPTHS)}."
            )
        return _dataset(self._handle.get(path), self.depth, "f", ndim=3, path=path)

    def _splits_path(self, path: Path) -> Path | None:
        if self.splits is not None:
            given = Path(self.splits).expanduser()
            if not given.is_file():
                raise DataError(f"data.source.splits: no file '{given}'. Use NYU's own splits.mat.")
            return given
        beside = path.with_name(_SPLITS)
        return beside if beside.is_file() else None

    def _splits(self, path: Path, count: int) -> list[str]:
        splits = [""] * count
        source = self._splits_path(path)
        if source is None:
            return splits
        numbers = read_mat5(read_bytes(source), where=f"'{source}'")
        for split in ("train", "test"):
            if f"{split}Ndxs" not in numbers:
                raise DataError(
                    f"'{source}': no variable {split}Ndxs, found {', '.join(numbers) or 'nothing'}. "
                    "Use NYU's own splits.mat."
                )
            for number in numbers[f"{split}Ndxs"].ravel().tolist():
                if not (1 <= number <= count and number == int(number)) or splits[int(number) - 1]:
                    raise DataError(
                        f"'{source}': {split}Ndxs names image {number:g}, listed twice or not one of "
                        f"1 to {count}. Use NYU's own splits.mat."
                    )
                splits[int(number) - 1] = split
        return splits


def _open(path: Path) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except OSError:
        raise DataError(f"'{path}': not an HDF5 file, or truncated. Copy the file again.") from None


def _dataset(file: h5py.File, name: str, kind: str, *, ndim: int, path: Path) -> h5py.Dataset:
    """Return a dataset whose values lie in this file and have the expected type."""
    link = file.get(name, getlink=True)
    found = file.get(name) if isinstance(link, h5py.HardLink) else None
    if not isinstance(found, h5py.Dataset) or found.external or found.is_virtual:
        raise DataError(f"'{path}': no array '{name}'. Pass data.root=<path of {_FILE}>.")
    if found.ndim != ndim or not found.dtype.str[1:].startswith(kind) or (ndim == 4 and found.shape[1] != 3):
        raise DataError(
            f"'{path}': '{name}' is {found.dtype} of shape {found.shape}. Pass data.root=<path of {_FILE}>."
        )
    check_pixels(found.shape[-1], found.shape[-2], where=f"'{path}' {name}")
    if found.chunks and np.prod(found.chunks, dtype=float) > 3 * MAX_PIXELS:  # a chunk is decompressed as a whole
        raise DataError(f"'{path}': '{name}' has chunks of {found.chunks} values. Repack the file.")
    return found


def _scenes(file: h5py.File, images: h5py.Dataset, path: Path) -> list[str]:
    table = file.get("scenes") if isinstance(file.get("scenes", getlink=True), h5py.HardLink) else None
    count = len(images)
    if (
        not isinstance(table, h5py.Dataset)
        or h5py.check_ref_dtype(table.dtype) is not h5py.Reference
        or table.size != count
    ):
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
