"""The tags of EXIF blocks and TIFF files of strangers: checked before Pillow copies them, and the one that matters."""

from __future__ import annotations

import re
import struct

from PIL import Image

from hudepth.base.errors import DataError

_ORIENTATION = 0x0112
_MAX_EXIF = 1 << 20  # bytes; a segment of a JPEG holds 65,533
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8}  # bytes by type


def check_tags(data: bytes, *, where: str) -> None:
    """Check the tags of a TIFF file or of a JPEG's EXIF block, which Pillow copies when it opens one.

    Tags that overlap make a small file fill the memory: together they may not be much longer than what holds them.

    Raises:
        DataError: if they are, or if an EXIF block is larger than 1 MiB.
    """
    block = data if data[:2] in (b"II", b"MM") else _jpeg_exif(data) if data[:2] == b"\xff\xd8" else b""
    overlap = sum(min(size, len(block)) for size, _ in _tags(block).values()) > 4 * len(block)
    if overlap or (len(block) > _MAX_EXIF and block is not data):
        raise DataError(f"{where}: its tags (EXIF) overlap or are too many. Save the picture again without them.")


def orientation(image: Image.Image) -> int:
    """Return the orientation tag of an opened image, 1 to 8; 1 where it has none or no valid one."""
    if image.format == "TIFF":
        found = getattr(image, "tag_v2", {}).get(_ORIENTATION, 1)
        return found if isinstance(found, int) else 1
    block = image.info.get("exif", b"")
    _, value = _tags(bytes(block).removeprefix(b"Exif\0\0")).get(_ORIENTATION, (0, 0))
    if not value:
        xmp = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
        text = xmp if isinstance(xmp, bytes) else str(xmp).encode()
        value = int(found[1]) if (found := re.search(rb"tiff:Orientation(?:=\"|>)([1-8])", text)) else 1
    return value


def _jpeg_exif(data: bytes) -> bytes:
    """Return the EXIF block of a JPEG file: its segments one after another, as Pillow joins them."""
    at, parts = 2, []
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        if data[at + 1] == 0xFF:  # a fill byte
            at += 1
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            parts.append(data[at + 10 : at + 2 + length])
        at += 2 + length
    return b"".join(parts)


def _tags(block: bytes) -> dict[int, tuple[int, int]]:
    """Return size and first number of each tag of the first directory of a TIFF structure; empty if it is none."""
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    if order is None or len(block) < 16:
        return {}
    big = block[2:4] in (b"+\0", b"\0+")  # BigTIFF
    start = struct.unpack_from(f"{order}Q" if big else f"{order}I", block, 8 if big else 4)[0]
    head, entry = (f"{order}Q", f"{order}HHQ8s") if big else (f"{order}H", f"{order}HHI4s")
    if start + struct.calcsize(head) > len(block):
        return {}
    (count,) = struct.unpack_from(head, block, start)
    at, tags = start + struct.calcsize(head), {}
    for _ in range(min(count, (len(block) - at) // struct.calcsize(entry))):
        tag, kind, length, value = struct.unpack_from(entry, block, at)
        tags[tag] = (_SIZES.get(kind, 1) * length, struct.unpack_from(f"{order}H", value)[0] if kind == 3 else 0)
        at += struct.calcsize(entry)
    return tags
