"""Photographs as people have them: any common format, upright, as RGB bytes. Files are untrusted."""

from __future__ import annotations

import io
import re
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray
from PIL import (
    AvifImagePlugin,
    BmpImagePlugin,
    GifImagePlugin,
    Image,
    JpegImagePlugin,
    PngImagePlugin,
    PpmImagePlugin,
    TiffImagePlugin,
    UnidentifiedImageError,
    WebPImagePlugin,
    features,
)

from hudepth.base.camera.exif import directory, exif_camera, orientation
from hudepth.base.camera.intrinsics import Intrinsics
from hudepth.base.errors import DataError

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what it cannot read becomes an error of one line
_PLUGINS = (
    JpegImagePlugin, PngImagePlugin, WebPImagePlugin, BmpImagePlugin, TiffImagePlugin, GifImagePlugin,
    PpmImagePlugin, *([AvifImagePlugin] if features.check("avif") else []),
)  # fmt: skip
FORMATS = tuple(plugin.__name__.rpartition(".")[2].removesuffix("ImagePlugin").upper() for plugin in _PLUGINS)
"""What is decoded. Pillow would also take formats that start other programs, as EPS does Ghostscript."""
SUFFIXES = (
    ".jpg", ".jpeg", ".jfif", ".jpe", ".png", ".webp", ".avif", ".bmp", ".tif", ".tiff", ".gif", ".ppm", ".pgm",
)  # fmt: skip
"""Extensions that are looked for in folders, in lower case."""

MAX_NATIVE_PIXELS = 25_000_000
"""Of a ground truth that is scored, which takes some 50 bytes a pixel. The largest public ones have 24 million."""
MAX_PIXELS = 100_000_000
"""Larger images are refused before they are decoded."""
_MAX_EXIF = 1 << 20  # bytes; a segment of a JPEG holds 65,533
_TURNS = {  # by orientation: what brings it upright
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # fmt: skip
MAX_FILE_BYTES = 1 << 30
"""Larger files are refused before they are read."""


class Photo(NamedTuple):
    """A decoded image."""

    rgb: UInt8[np.ndarray, "h w 3"]
    """Upright RGB."""
    notes: tuple[str, ...]
    """What was done to it that its owner may want to know."""
    camera: Intrinsics | str = ""
    """The camera that its EXIF states, or why it states none; empty if it says nothing of one."""


def read_photo(source: str | Path | bytes, *, where: str = "", max_pixels: int = MAX_PIXELS) -> Photo:
    """Decode an image and turn it upright as its orientation tag says.

    Grey, 16-bit, CMYK and palette images become 8-bit RGB; what is transparent is laid on white; of an animation the
    first frame is taken.

    Args:
        source: a path, or the bytes of a file.
        where: names the file in errors; the path by default.
        max_pixels: larger images are refused before they are decoded.

    Raises:
        DataError: if it is missing, empty, truncated, damaged, too large, or no image.
    """
    where = where or ("the image" if isinstance(source, bytes) else f"'{source}'")
    data = source if isinstance(source, bytes) else read_bytes(Path(source))
    if not data:
        raise DataError(f"{where}: the file is empty (0 bytes). Copy it again.")
    try:
        _check_tags(data, where)
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            check_pixels(image.height, image.width, where=where, most=max_pixels)
            notes = _notes(image)
            image.load()
            exif = data if image.format == "TIFF" else bytes(image.info.get("exif", b"")).removeprefix(b"Exif\0\0")
            turn = _TURNS.get(orientation(exif))
            rgb = pillow_rgb(image if turn is None else image.transpose(turn), where=where)
    except DataError:
        raise
    except UnidentifiedImageError:
        kind = "HEIC and its like are not read here" if data[4:8] == b"ftyp" else "no image that can be read"
        raise DataError(f"{where}: {kind}. Pass a {', '.join(FORMATS)}.") from None
    except Image.DecompressionBombError:
        raise DataError(f"{where}: more pixels than are decoded here. Resize the file.") from None
    except Exception as error:  # decoders know dozens of ways in which a file can be broken
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{where}: cannot be decoded, the file is truncated or damaged ({reason}).") from None
    return Photo(rgb, notes, exif_camera(exif, rgb.shape[0], rgb.shape[1]))


def _notes(image: Image.Image) -> tuple[str, ...]:
    if image.format == "TIFF":  # counting its pages would read all their tags
        return ()
    frames = int(getattr(image, "n_frames", 1))
    animated = frames > 1 and image.format != "MPO"  # whose further frames are thumbnails or a second eye
    return (f"animated, {frames} frames: the first is taken",) if animated else ()


def pillow_rgb(image: Image.Image, *, where: str = "image") -> UInt8[np.ndarray, "h w 3"]:
    """Return a Pillow image of any mode as 8-bit RGB, not turned; DataError if its pixels are floating-point."""
    if image.mode == "RGB":
        return np.asarray(image, np.uint8)
    if image.mode.startswith("I"):  # 16 bits of grey, which Pillow may hold in 32
        return as_rgb(np.asarray(image).clip(0, 65535).astype(np.uint16), where=where)
    if image.mode == "F":
        raise DataError(f"{where}: floating-point pixels have no known range. Save the image with 8 or 16 bits.")
    if image.has_transparency_data:
        rgba = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", rgba.size, (255, 255, 255, 255)), rgba)
    return np.asarray(image.convert("RGB"), np.uint8)


def _check_tags(data: bytes, where: str) -> None:
    """Refuse overlapping tags of a TIFF or of EXIF: Pillow copies each, so a small file would fill the memory."""
    jpeg = _jpeg_exif(data) if data[:2] == b"\xff\xd8" else b""
    starts = [m.start() for m in islice(re.finditer(rb"II\*\0|MM\0\*", data), 9)] if data[4:8] == b"ftyp" else [0]
    blocks = [memoryview(jpeg or data)[at:] for at in starts]  # of an AVIF, from where its EXIF may begin
    overlap = any(sum(min(tag.size, len(each)) for tag in directory(each).values()) > 4 * len(each) for each in blocks)
    if overlap or len(jpeg) > _MAX_EXIF or len(blocks) > 8:
        raise DataError(f"{where}: its tags (EXIF) overlap or are too many. Save the picture again without them.")


def _jpeg_exif(data: bytes) -> bytes:
    """Return the EXIF block of a JPEG file: its segments one after another, as Pillow joins them."""
    at, parts = 2, []
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        length = -1 if data[at + 1] == 0xFF else int.from_bytes(data[at + 2 : at + 4], "big")  # -1: a fill byte
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            parts.append(data[at + 10 : at + 2 + length])
        at += 2 + length
    return b"".join(parts)


def as_rgb(array: NDArray[Any], *, where: str = "image") -> UInt8[np.ndarray, "h w 3"]:
    """Return an array of pixels as 8-bit RGB.

    Args:
        array: [h, w] or [h, w, 1] grey, [h, w, 3] RGB or [h, w, 4] RGBA, of 8 or 16 bits.
        where: names it in errors.

    Raises:
        DataError: if it is none of these; the message says what it is.
    """
    grey = array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 1)
    if not (grey or (array.ndim == 3 and array.shape[2] in (3, 4))) or array.dtype not in (np.uint8, np.uint16):
        raise DataError(
            f"{where}: an array of {array.dtype} and shape {list(array.shape)}. "
            "Pass RGB as uint8 or uint16 of shape [height, width, 3]; grey and RGBA will do, too."
        )
    check_pixels(array.shape[0], array.shape[1], where=where)
    if array.dtype == np.uint16:
        array = cv2.convertScaleAbs(array, alpha=1 / 257)
    if grey:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(array), cv2.COLOR_GRAY2RGB), np.uint8)
    if array.shape[2] == 4:
        alpha = array[..., 3:].astype(np.float32) / 255
        array = np.rint(array[..., :3] * alpha + 255 * (1 - alpha))
    return np.ascontiguousarray(array, np.uint8)


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
        raise DataError(f"no file '{path}'. Copy it there, or take it off the list.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise DataError(f"'{path}': larger than {MAX_FILE_BYTES >> 20} MiB. It cannot be one depth map or list.")


def resize_image(image: UInt8[np.ndarray, "H W 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image at another size: averaged over areas where it shrinks, else bilinear.

    Args:
        image: RGB.
        size: (height, width).
    """
    height, width = size
    shrinks = image.shape[0] >= height and image.shape[1] >= width
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), np.uint8)
