"""What file-based sources share: paths that stay inside the root, bounded reads, decoding, lazy handles."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.base.images import check_file, check_pixels, read_bytes
from hudepth.data.sources.base import RawPair
from hudepth.data.sources.headers import image_size, is_tiff

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
"""Extensions of images, in lower case."""
DEPTH_SUFFIXES = (".png", ".npy", ".tif", ".tiff")
"""Extensions of depth maps, in lower case."""

Handle = TypeVar("Handle")


class PerProcess(Generic[Handle]):
    """A file handle opened on first use, once for each process, and left behind when pickled.

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
    """Return the path of ``name`` below ``root``.

    The check is of the name alone: links that the owner of the folder made are followed.

    Args:
        root: a folder.
        name: relative path from an index that anyone may have written.
        where: names the index in errors.

    Raises:
        DataError: if the name is empty, absolute, or leaves the folder by ``..``.
    """
    windows = PureWindowsPath(name)
    parts = {*PurePosixPath(name).parts, *windows.parts}
    if not name or "\0" in name or name.startswith("/") or windows.anchor or ".." in parts:
        raise DataError(f"{where}: path {name!r} is not inside the data folder. Use paths relative to '{root}'.")
    return root / name


def csv_rows(data: bytes, *, where: str) -> list[tuple[int, list[str]]]:
    """Return (line number, cells) for each line of a CSV file that is not blank.

    Any line ends are accepted, with or without a byte order mark.

    Raises:
        DataError: if it is no UTF-8 text or no CSV.
    """
    try:
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""))
        return [(reader.line_num, cells) for cells in reader if cells]
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{where}: not a CSV file in UTF-8 ({error}). Write it again.") from None


def read_image(source: Path | bytes, *, where: str = "") -> NDArray[np.uint8]:
    """Decode a JPEG or PNG; grey, RGBA and 16-bit images become 8-bit RGB.

    An orientation tag is not applied: the depth has none, and the two would no longer match.

    Args:
        source: a path, or the bytes of a file.
        where: names the file in errors; the path by default.

    Returns:
        [H, W, 3] RGB.

    Raises:
        DataError: if the file is missing, truncated, damaged, too large, or no image.
    """
    data, where = _load(source, where)
    if is_tiff(data):
        raise DataError(f"{where}: a TIFF cannot be the image of a pair. Store images as JPEG or PNG.")
    bgr = _decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, where)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def read_depth(source: Path | bytes, *, where: str = "") -> NDArray[np.generic]:
    """Decode a depth map without changing its values: PNG of 8 or 16 bits, TIFF, or two-dimensional ``.npy``.

    Args:
        source: a path, or the bytes of a PNG or TIFF.
        where: names the file in errors; the path by default.

    Returns:
        [H, W] stored values.

    Raises:
        DataError: if the file is missing, truncated, damaged, too large, or has several different channels.
    """
    if isinstance(source, Path) and source.suffix.lower() == ".npy":
        return _read_npy(source, where or f"'{source}'")
    data, where = _load(source, where)
    raw = _decode(data, cv2.IMREAD_UNCHANGED, where)
    if raw.ndim == 3 and raw.shape[2] == 3 and (raw == raw[..., :1]).all():
        raw = np.ascontiguousarray(raw[..., 0])  # grey saved as RGB
    if raw.ndim != 2:
        raise DataError(f"{where}: {raw.shape[2]} channels that differ are a picture, not depth. Store one channel.")
    return raw


def make_pair(image: NDArray[np.uint8], depth: NDArray[np.generic], *, image_where: str, depth_where: str) -> RawPair:
    """Join an image and its depth.

    Raises:
        DataError: if they differ in size.
    """
    if image.shape[:2] != depth.shape:
        (height, width), (rows, columns) = image.shape[:2], depth.shape
        raise DataError(
            f"{image_where} is {width} x {height} pixels but {depth_where} is {columns} x {rows}. "
            "Both must have one size."
        )
    return RawPair(image=image, depth=depth)


def read_pair(image: Path, depth: Path) -> RawPair:
    """Decode the two files of a pair.

    Raises:
        DataError: as :func:`read_image`, :func:`read_depth` and :func:`make_pair`.
    """
    return make_pair(read_image(image), read_depth(depth), image_where=f"'{image}'", depth_where=f"'{depth}'")


def _load(source: Path | bytes, where: str) -> tuple[bytes, str]:
    if isinstance(source, bytes):
        return source, where or "image data"
    return read_bytes(source), where or f"'{source}'"


def _decode(data: bytes, flags: int, where: str) -> NDArray[Any]:
    height, width = image_size(data, where=where)
    check_pixels(height, width, where=where)
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        decoded = None
    if decoded is None or decoded.shape[:2] != (height, width):
        raise DataError(f"{where}: cannot be decoded, the file is damaged. Copy the file again.")
    return decoded


def _read_npy(path: Path, where: str) -> NDArray[np.generic]:
    check_file(path)
    try:  # open_memmap reads the header alone, refuses pickles, and finds files that are cut short
        mapped = np.lib.format.open_memmap(path, mode="r")
    except (ValueError, OSError, OverflowError, TypeError, SyntaxError, EOFError):
        raise DataError(f"{where}: not a complete .npy array of plain numbers. Save it with numpy.save.") from None
    if mapped.ndim != 2 or mapped.dtype.kind not in "uif":
        raise DataError(f"{where}: {mapped.dtype} array of shape {mapped.shape}. Save one number per pixel, as [H, W].")
    check_pixels(*mapped.shape, where=where)
    return np.array(mapped, dtype=mapped.dtype.newbyteorder("="), order="C", subok=False)
