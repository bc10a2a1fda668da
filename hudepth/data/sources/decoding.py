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

from hudepth.base.camera.exif import orientation
from hudepth.base.errors import DataError
from hudepth.base.images import MAX_PIXELS, check_pixels, read_bytes
from hudepth.base.images.tags import exif_block
from hudepth.data.sources.arrays import read_npy, read_pfm

_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB\x60\x82"
_JPEG, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_TIFF = {b"II*\0": "<", b"MM\0*": ">", b"II+\0": "<", b"MM\0+": ">"}
"""Classic TIFF, then BigTIFF, each with its byte order."""
_EXR, _ZIP = b"v/1\x01", b"PK\x03\x04"


def read_image(source: Path | bytes, *, where: str = "", upright: bool = False) -> NDArray[np.uint8]:
    """Decode a JPEG or PNG file, or its bytes; grey, RGBA and 16-bit images become 8-bit RGB [H, W, 3].

    An orientation tag (EXIF) is not applied: published depth fits the stored pixels. With ``upright``, an image that
    has one other than 1 is refused. Raises DataError if the file (in errors: ``where``) is missing, truncated, damaged,
    too large, or not an image.
    """
    data, where = _load(source, where)
    if upright and (turned := orientation(exif_block(data))) != 1:
        raise DataError(
            f"{where}: EXIF orientation {turned}, so its depth may be upright, as hudepth-predict writes it, or as the "
            "image is stored. Save the image upright (mogrify -auto-orient), or, if its depth fits as it is stored, "
            "remove the tag (exiftool -Orientation=)."
        )
    if data[:4] in _TIFF:
        raise DataError(f"{where}: a TIFF cannot be the image of a pair. Store images as JPEG or PNG.")
    bgr = _decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, where)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def read_depth(source: Path | bytes, *, where: str = "", mask: bool = False) -> NDArray[np.generic]:
    """Decode a depth map [H, W] without changing its values: PNG of 8 or 16 bits, TIFF, PFM or ``.npy``.

    Takes a path, or the bytes of a PNG, TIFF or PFM. Grey may be saved as colour or a palette, and where alpha is 0 the
    value becomes 0; an array may be [1, H, W] or [H, W, 1]. A ``mask`` may be a PNG of fewer bits, whose values are
    stretched to 8 bits. Raises DataError if the file (in errors: ``where``) is missing, truncated, damaged, too large,
    of another kind, or has several different channels.
    """
    if isinstance(source, Path) and source.suffix.lower() == ".npy":
        return read_npy(source, where or f"'{source}'")
    data, where = _load(source, where)
    if data[:2] == b"Pf" or data[:2] == b"PF":
        return read_pfm(data, where)
    _refuse_kind(data, where, mask=mask)
    raw = _decode(data, cv2.IMREAD_UNCHANGED, where)
    if data[:4] in _TIFF and _tiff_tags(data)[1]:
        raise DataError(f"{where}: a TIFF of several pages, and which one is depth is unknown. Keep that one.")
    if raw.ndim == 3 and (raw[..., :3] == raw[..., :1]).all():  # grey saved as RGB, with a palette, or with alpha
        raw = raw[..., 0] * (raw[..., 3] > 0) if raw.shape[2] == 4 else np.ascontiguousarray(raw[..., 0])
    if raw.ndim != 2:
        held = f"{raw.shape[2]} channels of {raw.dtype} that differ"
        raise DataError(f"{where}: {held} are a picture, not depth. Store one channel of depth values, uncoloured.")
    return raw


def _refuse_kind(data: bytes, where: str, *, mask: bool) -> None:
    """Refuse files of kinds that people store depth in, but that are not read or lose values."""
    png = data.startswith(_PNG)
    if png and data[24:26] == b"\x10\x04":  # some releases of OpenCV swap its bytes
        raise DataError(f"{where}: a 16-bit grey PNG with alpha, which is not read. Store it without alpha.")
    if png and not mask and data[24:25] in (b"\x01", b"\x02", b"\x04"):  # decoders stretch them
        raise DataError(f"{where}: a PNG of {data[24]} bits a pixel, too few for depth. Store 16 bits.")
    if data.startswith(_JPEG):
        raise DataError(f"{where}: a JPEG, whose compression changes depths. Store them as 16-bit PNG or .npy.")
    if data.startswith(_EXR):
        raise DataError(f"{where}: an OpenEXR file, which is not read. Save its depth channel with numpy.save as .npy.")
    if data.startswith(_ZIP):
        raise DataError(f"{where}: an archive of arrays (.npz), which is not read. Save its depth with numpy.save.")


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
    if decoded is None and data[:4] in _TIFF:
        held = _describe_tiff(data)
        raise DataError(f"{where}: damaged, or a TIFF that is not read ({held}). Copy it again, or save it as .npy.")
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
    tags, _ = _tiff_tags(data)
    return tags[257], tags[256]


def _tiff_tags(data: bytes) -> tuple[dict[int, int], bool]:
    """Return the first value of each tag of the first directory, and whether there is another.

    TIFF 6.0, section 2. Pillow would also read the values of all tags, however many.
    """
    order, big = _TIFF[data[:4]], b"+" in data[2:4]
    where, counter, entry, step = ("Q", "Q", "HHQ8s", 20) if big else ("I", "H", "HHI4s", 12)
    try:
        (start,) = struct.unpack_from(f"{order}{where}", data, 8 if big else 4)
        (count,) = struct.unpack_from(f"{order}{counter}", data, start)
        first = start + struct.calcsize(f"={counter}")
        entries = [struct.unpack_from(f"{order}{entry}", data, first + step * i) for i in range(count)]
    except struct.error:
        raise EOFError("no directory") from None
    end = data[first + step * count :][: struct.calcsize(f"={where}")]
    kinds = {3: "H", 16: "Q"}
    values = {tag: struct.unpack_from(f"{order}{kinds.get(kind, 'I')}", value)[0] for tag, kind, _, value in entries}
    return values, any(end)


def _describe_tiff(data: bytes) -> str:
    tags, _ = _tiff_tags(data)
    kind = {1: "unsigned", 2: "signed", 3: "float"}.get(tags.get(339, 1), "unknown")
    return f"{tags.get(258, 1)}-bit {kind}, compression {tags.get(259, 1)}, predictor {tags.get(317, 1)}"
