"""Photographs as people have them: any common format, upright, as RGB bytes. Files are untrusted."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from hudepth.base.camera.exif import exif_camera, orientation
from hudepth.base.camera.intrinsics import Intrinsics
from hudepth.base.errors import DataError
from hudepth.base.images.files import MAX_PIXELS, check_pixels, read_bytes
from hudepth.base.images.formats import FORMATS, formats_of, why_unread
from hudepth.base.images.tags import check_tags

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what it cannot read becomes an error of one line
_TURNS = {  # by orientation: what brings it upright
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # fmt: skip


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
        check_tags(data, where)
        with Image.open(io.BytesIO(data), formats=formats_of(data)) as image:
            check_pixels(image.height, image.width, where=where, most=max_pixels)
            notes = _notes(image)
            image.load()
            exif = data if image.format == "TIFF" else bytes(image.info.get("exif") or b"").removeprefix(b"Exif\0\0")
            turn = _TURNS.get(orientation(exif))
            rgb = pillow_rgb(image if turn is None else image.transpose(turn), where=where)
    except DataError:
        raise
    except UnidentifiedImageError:
        raise DataError(f"{where}: {why_unread(data)} Pass a {', '.join(FORMATS)}.") from None
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
    animated = frames > 1 and image.format not in ("MPO", "HEIF")  # which add a second eye, or a burst
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
