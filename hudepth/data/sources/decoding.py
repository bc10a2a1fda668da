"""Decode images and depth maps: OpenCV reads the pixels, Pillow checks size and completeness beforehand."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, JpegImagePlugin, PngImagePlugin

from hudepth.base.errors import DataError
from hudepth.base.images import MAX_PIXELS, check_file, check_pixels, read_bytes

_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB\x60\x82"
_JPEG, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}


def read_image(source: Path | bytes, *, where: str = "") -> NDArray[np.uint8]:
    """Decode a JPEG or PNG file, or its bytes; grey, RGBA and 16-bit images become 8-bit RGB [H, W, 3].

    An orientation tag is not applied: the depth has none, and the two would no longer match. Raises DataError if the
    file (in errors: ``where``) is missing, truncated, damaged, too large, or not an image.
    """
    data, where = _load(source, where)
    if data[:4] in _TIFF:
        raise DataError(f"{where}: a TIFF cannot be the image of a pair. Store images as JPEG or PNG.")
    bgr = _decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, where)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def read_depth(source: Path | bytes, *, where: str = "") -> NDArray[np.generic]:
    """Decode a depth map [H, W] without changing its values: PNG of 8 or 16 bits, TIFF, or two-dimensional ``.npy``.

    Takes a path, or the bytes of a PNG or TIFF. Raises DataError if the file (in errors: ``where``) is missing,
    truncated, damaged, too large, or has several different channels.
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


def _load(source: Path | bytes, where: str) -> tuple[bytes, str]:
    return (
        (source, where or "image data") if isinstance(source, bytes) else (read_bytes(source), where or f"'{source}'")
    )


def _decode(data: bytes, flags: int, where: str) -> NDArray[Any]:
    height, width = image_size(data, where=where)  # before cv2, which allocates whatever size a header claims
    check_pixels(height, width, where=where)
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        decoded = None
    if decoded is None or decoded.shape[:2] != (height, width):
        raise DataError(f"{where}: cannot be decoded, the file is damaged. Copy the file again.")
    return decoded


def image_size(data: bytes, *, where: str) -> tuple[int, int]:
    """Return (height, width) of a complete PNG, JPEG or TIFF without decoding it.

    Some releases of OpenCV fill what a truncated file lacks with grey, so the end of the file is looked for here.
    Raises DataError if the file is of another kind, truncated or damaged.
    """
    kinds = {_PNG: ("PNG", _png_size), _JPEG: ("JPEG", _jpeg_size)} | dict.fromkeys(_TIFF, ("TIFF", _tiff_size))
    kind, read_size = next((value for start, value in kinds.items() if data.startswith(start)), (None, None))
    if read_size is None:
        found = f"a file that begins with {data[:8]!r}" if data else "an empty file"
        raise DataError(f"{where}: neither PNG, JPEG nor TIFF but {found}. Replace it.")
    try:
        return read_size(data)
    except Exception as error:  # Pillow has dozens of ways to say that a file is broken
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{where}: the {kind} is truncated or damaged ({reason}). Copy the file again.") from None


def _png_size(data: bytes) -> tuple[int, int]:
    if _PNG_END not in data:
        raise EOFError("no end of the image")
    with PngImagePlugin.PngImageFile(io.BytesIO(data)) as image:  # not Image.open, which has its own limit of pixels
        width, height = image.size
        if height * width <= MAX_PIXELS:
            image.verify()  # checksums of all chunks
    return height, width


class _JpegHeader(JpegImagePlugin.JpegImageFile):
    def getexif(self) -> Image.Exif:
        """Skip Exif data, which a hostile file can make expensive to read."""
        return Image.Exif()


def _jpeg_size(data: bytes) -> tuple[int, int]:
    stream = io.BytesIO(data)
    with _JpegHeader(stream) as image:
        # Pillow stops at the first scan: thumbnails, with end markers of their own, lie before it.
        if data.find(_JPEG_END, stream.tell()) < 0:
            raise EOFError("no end of the image")
        return image.height, image.width


def _tiff_size(data: bytes) -> tuple[int, int]:
    """Read the first directory (TIFF 6.0, section 2). Pillow would also read the values of all tags, however many."""
    order = _TIFF[data[:4]]
    try:
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, start)
        entries = [struct.unpack_from(f"{order}HHI4s", data, start + 2 + 12 * i) for i in range(count)]
    except struct.error:
        raise EOFError("no directory") from None
    values = {tag: (f"{order}{'H' if kind == 3 else 'I'}", value) for tag, kind, _, value in entries}
    height, width = (struct.unpack_from(*values[tag])[0] for tag in (257, 256))
    return height, width


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
