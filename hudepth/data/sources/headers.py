"""Size and completeness of an encoded image, read from its container before anything is decoded.

Decoders cannot be relied on here: some releases of OpenCV fill what a truncated file lacks with grey, and
all of them allocate whatever size the header claims.
"""

from __future__ import annotations

import re
import struct
import zlib

from hudepth.base.errors import DataError

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_TIFF = {b"II*\x00": "<", b"MM\x00*": ">"}
# After 0xFF, 0x00 is an escaped data byte, 0xD0 to 0xD7 restart the decoder, 0xFF pads: others are markers.
_JPEG_MARKER = re.compile(rb"\xff+([^\x00\xff\xd0-\xd7])", re.DOTALL)
_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_END = 0xD9
_JPEG_SCAN = 0xDA
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257


def image_size(data: bytes, *, where: str) -> tuple[int, int]:
    """Return (height, width) in pixels of a complete PNG, JPEG or TIFF.

    Args:
        data: the whole file.
        where: names the file in errors.

    Raises:
        DataError: if the file is of another kind, truncated or damaged.
    """
    if data.startswith(_PNG):
        return _png_size(data, where)
    if data.startswith(_JPEG):
        return _jpeg_size(data, where)
    if data[:4] in _TIFF:
        return _tiff_size(data, where)
    found = "an empty file" if not data else f"a file that begins with {data[:8]!r}"
    raise DataError(f"{where}: neither PNG, JPEG nor TIFF but {found}. Replace it.")


def is_tiff(data: bytes) -> bool:
    """Tell whether the file is a TIFF."""
    return data[:4] in _TIFF


def _png_size(data: bytes, where: str) -> tuple[int, int]:
    """Walk the chunks (PNG specification, section 5): each is length, type, body, CRC; the last is IEND."""
    at, kind, size = len(_PNG), b"", (0, 0)
    while kind != b"IEND":
        if at + 12 > len(data):
            raise _truncated("PNG", where)
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + length
        if end + 4 > len(data):
            raise _truncated("PNG", where)
        if zlib.crc32(memoryview(data)[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise DataError(f"{where}: the PNG is damaged (checksum of chunk {kind!r}). Copy the file again.")
        if at == len(_PNG):
            if kind != b"IHDR" or length != 13:
                raise DataError(f"{where}: the PNG is damaged (it has no header). Copy the file again.")
            width, height = struct.unpack_from(">II", data, at + 8)
            size = (height, width)
        at = end + 4
    return size


def _jpeg_size(data: bytes, where: str) -> tuple[int, int]:
    """Walk the segments (ITU-T T.81, annex B) to the end-of-image marker; thumbnails are stepped over."""
    at, size, scanned = 2, (0, 0), False
    while marker := _JPEG_MARKER.search(data, at):
        code, at = marker[1][0], marker.end()
        if code == _JPEG_END:
            break
        if code in (0x01, 0xD8):  # markers without a body
            continue
        if at + 2 > len(data):
            raise _truncated("JPEG", where)
        length = struct.unpack_from(">H", data, at)[0]
        if code in _JPEG_SIZE_MARKERS:
            if at + 7 > len(data):
                raise _truncated("JPEG", where)
            height, width = struct.unpack_from(">HH", data, at + 3)
            size = max(size, (height, width), key=lambda hw: hw[0] * hw[1])
        scanned |= code == _JPEG_SCAN
        at += max(length, 2)
    if not marker or not scanned:
        raise _truncated("JPEG", where)
    return size


def _tiff_size(data: bytes, where: str) -> tuple[int, int]:
    """Read the first directory (TIFF 6.0, section 2): entries of tag, type, count, value."""
    order, found = _TIFF[data[:4]], {}
    try:
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, start)
        for entry in range(count):
            at = start + 2 + 12 * entry
            tag, kind = struct.unpack_from(f"{order}HH", data, at)
            if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
                found[tag] = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", data, at + 8)[0]
        return found[_TIFF_HEIGHT], found[_TIFF_WIDTH]
    except (struct.error, KeyError):
        raise _truncated("TIFF", where) from None


def _truncated(kind: str, where: str) -> DataError:
    return DataError(f"{where}: the {kind} is truncated ({kind} data without its end). Copy the file again.")
