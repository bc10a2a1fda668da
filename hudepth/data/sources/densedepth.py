"""DenseDepth's packaging of NYU Depth V2: its training frames and test set, the data of most small models."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from hudepth.base.errors import DataError
from hudepth.base.images import read_bytes
from hudepth.base.options import Choice
from hudepth.data.encoding import Encoding
from hudepth.data.sources.base import EncodedSource, RawPair, Record, existing_root
from hudepth.data.sources.decoding import read_depth, read_image
from hudepth.data.sources.files import PerProcess, csv_rows, make_pair
from hudepth.data.sources.nyu import Nyu, category_of

MAX_MEMBER_BYTES = 64 << 20
"""Larger members of the zip file are refused before they are decompressed."""
_ZIP = "nyu_data.zip"
_LISTS = {"train": "nyu2_train.csv", "test": "nyu2_test.csv"}
_FRAME = {
    "train": re.compile(r"data/nyu2_train/(?P<scene>[^/\\]+)_out/(?P<number>[0-9]{1,9})\.(jpe?g|png)"),
    "test": re.compile(r"data/nyu2_test/(?P<scene>)(?P<number>[0-9]{1,9})_(colors|depth)\.png"),
}


@dataclass(eq=False)
class DenseDepthSource(Nyu, EncodedSource):
    """DenseDepth's ``nyu_data.zip``, in place or unpacked: 50,688 training and 654 test pairs of 640 x 480.

    Published by Alhashim and Wonka (2018). Two lists without a header name the files:

    - ``data/nyu2_train.csv``: ``data/nyu2_train/<scene>_out/<n>.jpg`` and ``.png``; in-painted depth in
      8 bits, value / 255 * 10 m.
    - ``data/nyu2_test.csv``: ``data/nyu2_test/NNNNN_colors.png`` and ``NNNNN_depth.png``; the official
      test frames, 16-bit millimetres, scene unknown (empty).

    ``encoding="auto"`` reads both correctly. ``root`` is the zip file, the folder with the zip file, the unpacked
    folder, or its folder ``data``.
    """

    name: ClassVar[str] = "densedepth"
    auto_uint8: ClassVar[str | None] = "uint8_10m"

    root: str | Path | None
    _: KW_ONLY
    subset: Annotated[str, Choice(("train", "test", "all"))] = "train"
    encoding: Encoding = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._handle = PerProcess(_open)
        self._records: list[Record] = []

    def records(self) -> Sequence[Record]:
        """List the pairs in order of the CSV files, which are read once; see :meth:`Source.records`."""
        if self._records:
            return self._records
        records: list[Record] = []
        lines: dict[str, int] = {}
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
                    raise DataError(f"{where}: '{record.id}' is already on line {lines[record.id]}. Remove one.")
                lines[record.id] = line
                records.append(record)
        self._records = records
        return records

    def read(self, record: Record) -> RawPair:
        """Decode one pair; see :meth:`Source.read`."""
        for name in (record.image, record.depth):
            if not any(pattern.fullmatch(name) for pattern in _FRAME.values()):
                raise DataError(f"{self._where(name)}: not the name of a DenseDepth frame.")
        image_where, depth_where = self._where(record.image), self._where(record.depth)
        image = read_image(self._bytes(record.image), where=image_where)
        depth = read_depth(self._bytes(record.depth), where=depth_where)
        return make_pair(image, depth, image_where=image_where, depth_where=depth_where)

    def files(self) -> Sequence[Path]:
        """Return the zip file, or the lists and every file they name."""
        place = self._place()
        if place.is_file():
            return [place]
        names = [name for record in self.records() for name in (record.image, record.depth)]
        return [*(place / _LISTS[split] for split in self._splits()), *(_below(place, name) for name in names)]

    def _splits(self) -> Sequence[str]:
        return tuple(_LISTS) if self.subset == "all" else (self.subset,)

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
        found = ",".join(cells)[:120]
        raise DataError(f"{where}: {found!r} is not a pair of DenseDepth's {split} set. Copy the list again.")
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
