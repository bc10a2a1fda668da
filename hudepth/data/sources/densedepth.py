"""The training frames and the test set that DenseDepth published, the data of most small models."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from hudepth.base.errors import ConfigError, DataError, did_you_mean
from hudepth.base.images import read_bytes
from hudepth.data.encoding import check_encoding
from hudepth.data.sources.base import RawPair, Record, Source, existing_root
from hudepth.data.sources.files import PerProcess, csv_rows, make_pair, read_depth, read_image
from hudepth.data.sources.pairing import category_of

MAX_MEMBER_BYTES = 64 << 20
"""Larger members of the zip file are refused before they are decompressed."""

_ZIP = "nyu_data.zip"
_LISTS = {"train": "nyu2_train.csv", "test": "nyu2_test.csv"}
_SUBSETS = ("train", "test", "all")
_FRAME = {
    "train": re.compile(r"data/nyu2_train/(?P<scene>[^/\\]+)_out/(?P<number>[0-9]{1,9})\.(jpe?g|png)"),
    "test": re.compile(r"data/nyu2_test/(?P<scene>)(?P<number>[0-9]{1,9})_(colors|depth)\.png"),
}


class DenseDepthSource(Source):
    """DenseDepth's ``nyu_data.zip``, in place or unpacked: 50,688 training and 654 test pairs of 640 x 480.

    Published by Alhashim and Wonka (2018). Two lists without a header name the files:

    - ``data/nyu2_train.csv``: ``data/nyu2_train/<scene>_out/<n>.jpg`` and ``.png``; in-painted depth in
      8 bits, value / 255 * 10 m.
    - ``data/nyu2_test.csv``: ``data/nyu2_test/NNNNN_colors.png`` and ``NNNNN_depth.png``; the official
      test frames, 16-bit millimetres, scene unknown (empty).

    ``encoding="auto"`` reads both rightly.

    Args:
        root: the zip file, the folder with the zip file, the unpacked folder, or its folder ``data``.
        subset: ``train``, ``test`` or ``all``.
        encoding: how depth values become metres.
    """

    name: ClassVar[str] = "densedepth"
    auto_uint8: ClassVar[str | None] = "uint8_10m"

    def __init__(self, root: str | Path | None, *, subset: str = "train", encoding: str = "auto") -> None:
        self.root = root
        self.subset = subset
        self.encoding = encoding
        self._handle = PerProcess(_open)
        self._records: list[Record] | None = None

    def records(self) -> Sequence[Record]:
        """List the pairs in order of the CSV files, which are read once; the images need not be there.

        Raises:
            ConfigError: if an option is unknown.
            DataError: if a list is missing, empty or malformed.
        """
        if self._records is None:
            check_encoding(self.encoding)
            self._records = self._listed()
        return self._records

    def _listed(self) -> list[Record]:
        records: list[Record] = []
        lines: dict[str, str] = {}
        for split in self._splits():
            name = f"data/{_LISTS[split]}"
            index = self._where(name)
            rows = csv_rows(self._bytes(name), where=index)
            if not rows:
                raise DataError(f"{index}: lists no pairs. Copy the file again.")
            for line, cells in rows:
                where = f"{index} line {line}"
                record = _record(cells, split, where)
                if record.id in lines:
                    raise DataError(f"{where}: '{record.id}' is listed already, in {lines[record.id]}. Remove one.")
                lines[record.id] = f"line {line}"
                records.append(record)
        return records

    def read(self, record: Record) -> RawPair:
        """Decode one pair.

        Raises:
            DataError: if a file is missing, too large, truncated, or the two differ in size.
        """
        for name in (record.image, record.depth):
            if not _FRAME["train"].fullmatch(name) and not _FRAME["test"].fullmatch(name):
                raise DataError(f"{self._where(name)}: not a name of DenseDepth's frames.")
        image_where, depth_where = self._where(record.image), self._where(record.depth)
        return make_pair(
            read_image(self._bytes(record.image), where=image_where),
            read_depth(self._bytes(record.depth), where=depth_where),
            image_where=image_where,
            depth_where=depth_where,
        )

    def files(self) -> Sequence[Path]:
        """Return the zip file, or the lists and every file on them.

        Raises:
            DataError: as :meth:`records`.
        """
        place = self._place()
        if place.is_file():
            return [place]
        lists = [place / _LISTS[split] for split in self._splits()]
        return [
            *lists,
            *(_below(place, name) for record in self.records() for name in (record.image, record.depth)),
        ]

    def _splits(self) -> Sequence[str]:
        if self.subset not in _SUBSETS:
            raise ConfigError(
                f"data.source.subset: no subset '{self.subset}'.{did_you_mean(self.subset, _SUBSETS)} "
                f"Choose one of {', '.join(_SUBSETS)}."
            )
        return ("train", "test") if self.subset == "all" else (self.subset,)

    def _place(self) -> Path:
        """Return the zip file or the folder that holds the lists."""
        root = existing_root(self.root, expects=f"path of {_ZIP} or of its unpacked folder")
        first = _LISTS[self._splits()[0]]
        if root.is_file():
            return root
        for folder in (root / "data", root):
            if (folder / first).is_file():
                return folder
        if (root / _ZIP).is_file():
            return root / _ZIP
        raise DataError(
            f"data.root: neither '{first}' nor '{_ZIP}' in '{root}'. "
            f"Pass data.root=<path of {_ZIP} or of its unpacked folder>, or run with data=rooms."
        )

    def _where(self, name: str) -> str:
        place = self._place()
        return f"'{_below(place, name)}'" if place.is_dir() else f"'{name}' in '{place}'"

    def _bytes(self, name: str) -> bytes:
        place = self._place()
        if place.is_dir():
            return read_bytes(_below(place, name))
        return _member(self._handle.get(place), name, where=self._where(name))


def _below(folder: Path, name: str) -> Path:
    return folder / name.removeprefix("data/")


def _record(cells: Sequence[str], split: str, where: str) -> Record:
    frames = [_FRAME[split].fullmatch(cell.strip()) for cell in cells]
    if len(frames) != 2 or frames[0] is None or frames[1] is None:
        raise DataError(
            f"{where}: {','.join(cells)[:120]!r} is no pair of DenseDepth's {split} set. Copy the list again."
        )
    image, depth = frames[0], frames[1]
    scene, number = image["scene"], image["number"]
    if (scene, number) != (depth["scene"], depth["number"]):
        raise DataError(f"{where}: '{image[0]}' and '{depth[0]}' are of different frames. Copy the list again.")
    return Record(
        id=f"{scene or split}/{number}",
        scene=scene,
        frame=int(number),
        split=split,
        category=category_of(scene),
        image=image[0],
        depth=depth[0],
    )


def _open(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError):
        raise DataError(f"'{path}': not a zip file, or truncated. Copy the file again.") from None


def _member(archive: zipfile.ZipFile, name: str, *, where: str) -> bytes:
    try:
        member = archive.getinfo(name)
    except KeyError:
        raise DataError(f"no file {where}. Copy the zip file again.") from None
    if member.file_size > MAX_MEMBER_BYTES:
        raise DataError(f"{where}: larger than {MAX_MEMBER_BYTES >> 20} MiB. It cannot be one image or list.")
    try:
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise zipfile.BadZipFile  # zipfile does not bound what the other methods unpack
        return archive.read(member)
    except (zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError, EOFError, OSError):
        raise DataError(f"{where}: cannot be unpacked, the zip file is damaged. Copy the zip file again.") from None
