"""What file-based sources share: reading pairs below a root, paths that stay inside it, lazy handles."""

from __future__ import annotations

import csv
import io
import os
from abc import abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.data.sources.base import EncodedSource, RawPair, Record
from hudepth.data.sources.decoding import read_depth, read_image

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
DEPTH_SUFFIXES = (".png", ".npy", ".tif", ".tiff", ".pfm")
OTHER_DEPTH_SUFFIXES = (".npz", ".exr", ".jpg", ".jpeg")
"""Looked for where there is none of the former: reading them says why they cannot be read."""

Handle = TypeVar("Handle")


class FileSource(EncodedSource):
    """A source whose records name files by their paths relative to a folder."""

    unequal_sizes: bool | None = None
    """Whether image and depth may differ in size, if both show the same view; None if this is no option."""
    upright: ClassVar[bool] = False
    """Whether images must not state that they are to be turned: for anybody's files. Published sets fit as stored."""

    @abstractmethod
    def folder(self) -> Path:
        """Return the folder of the files; DataError if it is missing."""

    def read(self, record: Record) -> RawPair:
        """Decode the two files of a pair; see :meth:`Source.read`."""
        image, depth = (inside(self.folder(), name, where="data.root") for name in (record.image, record.depth))
        return make_pair(
            read_image(image, upright=self.upright), read_depth(depth),
            image_where=f"'{image}'", depth_where=f"'{depth}'", unequal=self.unequal_sizes,
        )  # fmt: skip

    def files(self) -> Sequence[Path]:
        """Return every image and depth map."""
        folder = self.folder()
        return [folder / name for record in self.records() for name in (record.image, record.depth)]


class PerProcess(Generic[Handle]):
    """A file handle opened on first use, once in each process, and left behind when pickled.

    A handle shared by a fork would share its file position, and h5py's cannot be pickled at all.
    """

    def __init__(self, open_file: Callable[[Path], Handle]) -> None:
        self._open = open_file
        self._held: tuple[int, Path, Handle] | None = None

    def get(self, path: Path) -> Handle:
        """Return this process's handle of ``path``."""
        if self._held is None or self._held[:2] != (os.getpid(), path):
            self._held = (os.getpid(), path, self._open(path))
        return self._held[2]

    def __getstate__(self) -> dict[str, Any]:
        return {"_open": self._open, "_held": None}


def inside(root: Path, name: str, *, where: str) -> Path:
    """Return the path of an untrusted ``name`` below ``root``. Only the name is checked: links are followed.

    Raises DataError if the name is empty, absolute, or leaves the folder by ``..``; ``where`` names the index.
    """
    windows = PureWindowsPath(name)
    parts = {*PurePosixPath(name).parts, *windows.parts}
    if not name or "\0" in name or name.startswith("/") or windows.anchor or ".." in parts:
        raise DataError(f"{where}: path {name!r} is not inside the data folder. Use paths relative to '{root}'.")
    return root / name


def csv_rows(data: bytes, *, where: str) -> list[tuple[int, list[str]]]:
    """Return (line number, cells) for each line of a CSV file that is not blank, whatever its line ends.

    Cells are separated by commas, or by what the first line has more of: semicolons, as Excel writes in many
    countries, or tabs. Raises DataError if it is not UTF-8 text or not a CSV.
    """
    try:
        text = data.decode("utf-8-sig")
        separator = max(",;\t", key=text.partition("\n")[0].count)
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
        return [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{where}: not a CSV file in UTF-8 ({error}). Write it again.") from None


def make_pair(
    image: NDArray[np.uint8],
    depth: NDArray[np.generic],
    *,
    image_where: str,
    depth_where: str,
    unequal: bool | None = None,
) -> RawPair:
    """Join an image and its depth. ``unequal``: whether sizes may differ; None if the source has no such option.

    Raises DataError if they differ in size, or if they may, in aspect ratio.
    """
    (height, width), (rows, columns) = image.shape[:2], depth.shape
    # The aspect ratio of the smaller one is only known to a pixel.
    alike = abs(width * rows - height * columns) <= max(height, rows)
    if image.shape[:2] != depth.shape and not (alike and unequal):
        fix = f"Both must have one {'aspect ratio' if unequal else 'size'}."
        if alike and unequal is False:
            fix += " If they show the same view, pass data.source.unequal_sizes=true."
        raise DataError(f"{image_where} is {width} x {height} pixels but {depth_where} is {columns} x {rows}. {fix}")
    return RawPair(image=image, depth=depth)
