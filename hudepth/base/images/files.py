"""Files that may hold anything: their size is checked before they are read or decoded."""

from __future__ import annotations

from pathlib import Path

from hudepth.base.errors import DataError

MAX_NATIVE_PIXELS = 25_000_000
"""Of a ground truth that is scored, which takes some 50 bytes a pixel. The largest public ones have 24 million."""
MAX_PIXELS = 100_000_000
"""Larger images are refused before they are decoded."""
MAX_FILE_BYTES = 1 << 30
"""Larger files are refused before they are read."""


def read_bytes(path: Path) -> bytes:
    """Read a whole file of at most :data:`MAX_FILE_BYTES`.

    Raises:
        DataError: if it is missing, too large or unreadable.
    """
    check_file(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"'{path}': cannot be read ({error.strerror}). Check its permissions.") from None


def check_pixels(height: int, width: int, *, where: str, most: int = MAX_PIXELS) -> None:
    """Accept sizes of 1 to ``most`` pixels.

    Raises:
        DataError: for any other size.
    """
    if not 0 < height * width <= most:
        raise DataError(
            f"{where}: {width} x {height} pixels, allowed are 1 to {most / 1e6:g} million. Resize the file."
        )


def check_file(path: Path) -> None:
    """Check that a file is there and not too large to read.

    Raises:
        DataError: if it is missing or larger than :data:`MAX_FILE_BYTES`.
    """
    if not path.is_file():
        if path.is_dir():
            raise DataError(f"'{path}' is a folder. Pass a file of it.")
        raise DataError(f"no file '{path}'. Copy it there, or take it off the list.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise DataError(f"'{path}': larger than {MAX_FILE_BYTES >> 20} MiB. It cannot be one depth map or list.")
