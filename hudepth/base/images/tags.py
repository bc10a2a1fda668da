"""What a picture's file says of itself besides its pixels, checked before a decoder copies it."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from itertools import accumulate, islice

from hudepth.base.camera.exif import directory
from hudepth.base.errors import DataError

_MAX_EXIF = 1 << 20  # bytes; a segment of a JPEG holds 65,533


def check_tags(data: bytes, where: str) -> None:
    """Refuse overlapping tags of a TIFF or of EXIF, or items of a HEIC: each is copied, so small files fill the memory.

    Raises:
        DataError: if they claim more than four times the bytes there are.
    """
    jpeg = exif_block(data) if data[:2] == b"\xff\xd8" else b""
    starts = [m.start() for m in islice(re.finditer(rb"II\*\0|MM\0\*", data), 9)] if data[4:8] == b"ftyp" else [0]
    blocks = [memoryview(jpeg or data)[at:] for at in starts]  # of an AVIF, from where its EXIF may begin
    overlap = any(sum(min(tag.size, len(each)) for tag in directory(each).values()) > 4 * len(each) for each in blocks)
    overlap |= any(total > 4 * len(data) for total in accumulate(_item_sizes(data)))
    if overlap or len(jpeg) > _MAX_EXIF or len(blocks) > 8:
        raise DataError(f"{where}: its tags (EXIF) overlap or are too many. Save the picture again without them.")


def exif_block(data: bytes) -> bytes:
    """Return the EXIF block of a JPEG or PNG file, empty if it has none; of a JPEG its segments joined, as Pillow does.

    Only the headers of segments and chunks are read: nothing is decoded.
    """
    if data.startswith(b"\x89PNG"):
        at = 8
        while at + 8 <= len(data) and data[at + 4 : at + 8] != b"eXIf":
            at += 12 + int.from_bytes(data[at : at + 4], "big")
        return data[at + 8 : at + 8 + int.from_bytes(data[at : at + 4], "big")].removeprefix(b"Exif\0\0")
    at, parts = 2, []
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        length = -1 if data[at + 1] == 0xFF else int.from_bytes(data[at + 2 : at + 4], "big")  # -1: a fill byte
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            parts.append(data[at + 10 : at + 2 + length])
        at += 2 + length
    return b"".join(parts)


def _item_sizes(data: bytes) -> Iterator[int]:
    """Yield the bytes that each part of each item claims, pixels and EXIF, of a HEIC or an AVIF (ISO/IEC 14496-12)."""
    if data[4:8] != b"ftyp":
        return
    for kind, start, end in _boxes(data, 0, len(data)):
        for inner, at, stop in _boxes(data, start + 4, end) if kind == b"meta" else ():
            if inner == b"iloc":
                yield from _extents(data[at:stop], whole=len(data))


def _boxes(data: bytes, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, start and end of the content of each box."""
    while at + 8 <= end:
        length, kind = struct.unpack_from(">I4s", data, at)
        head = 8
        if length == 1 and at + 16 <= end:
            length, head = int.from_bytes(data[at + 8 : at + 16], "big"), 16
        stop = min(end, at + length) if length else end
        yield kind, at + head, stop
        at += max(head, length or end)


def _extents(box: bytes, *, whole: int) -> Iterator[int]:
    """Yield the length of each extent of an ItemLocationBox; one without a length is the whole file."""
    version, at = box[0] if box else 0, 6

    def take(size: int) -> int:
        nonlocal at
        at += size
        return int.from_bytes(box[at - size : at], "big")

    offset, length, base, index = (nibble for byte in box[4:6].ljust(2, b"\0") for nibble in (byte >> 4, byte & 15))
    for _ in range(take(4 if version == 2 else 2)):
        if at >= len(box):
            return
        take((4 if version == 2 else 2) + (2 if version else 0) + 2 + base)  # its number, how and where it is kept
        for _ in range(take(2)):
            take((index if version else 0) + offset)
            yield take(length) or whole
