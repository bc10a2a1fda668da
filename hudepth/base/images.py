"""Photographs as people have them: any common format, upright, as RGB bytes. Files are untrusted."""

from __future__ import annotations

import io
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

from hudepth.base.errors import DataError
from hudepth.base.exif import check_tags, orientation

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

MAX_PIXELS = 100_000_000
"""Larger images are refused before they are decoded."""

_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # fmt: skip
"""What brings a picture of each orientation upright."""
MAX_FILE_BYTES = 1 << 30
"""Larger files are refused before they are read."""


class Photo(NamedTuple):
    """A decoded image."""

    rgb: UInt8[np.ndarray, "h w 3"]
    """Upright RGB."""
    notes: tuple[str, ...]
    """What was done to it that its owner may want to know."""


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
        check_tags(data, where=where)
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            check_pixels(image.height, image.width, where=where, most=max_pixels)
            notes = _notes(image)
            image.load()
            rgb = _to_rgb(image, where)
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
    return Photo(rgb, notes)


def _notes(image: Image.Image) -> tuple[str, ...]:
    if image.format == "TIFF":  # counting its pages would read all their tags
        return ()
    frames = int(getattr(image, "n_frames", 1))
    animated = frames > 1 and image.format != "MPO"  # whose further frames are thumbnails or a second eye
    return (f"animated, {frames} frames: the first is taken",) if animated else ()


def _to_rgb(image: Image.Image, where: str) -> UInt8[np.ndarray, "h w 3"]:
    turn = _TURNS.get(orientation(image))
    upright = image if turn is None else image.transpose(turn)
    if upright.mode == "RGB":
        return np.asarray(upright, np.uint8)
    if upright.mode.startswith("I"):  # 16 bits of grey, which Pillow may hold in 32
        return as_rgb(np.asarray(upright).clip(0, 65535).astype(np.uint16), where=where)
    if upright.mode == "F":
        raise DataError(f"{where}: floating-point pixels have no known range. Save the image with 8 or 16 bits.")
    if upright.has_transparency_data:
        rgba = upright.convert("RGBA")
        white = Image.new("RGBA", rgba.size, (255, 255, 255, 255))
        upright = Image.alpha_composite(white, rgba)
    return np.asarray(upright.convert("RGB"), np.uint8)


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


def is_image(path: Path) -> bool:
    """Return whether a file begins as an image does; False if it cannot be read."""
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError:
        return False
    return (
        head.startswith((b"\xff\xd8\xff", b"\x89PNG", b"GIF8", b"II*\0", b"MM\0*"))
        or head[4:8] == b"ftyp"
        or (head[:4] == b"RIFF" and head[8:12] == b"WEBP")
    )


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
