"""The formats of pictures that are decoded, and why others are not."""

from __future__ import annotations

import importlib.util

from PIL import (
    AvifImagePlugin,
    BmpImagePlugin,
    GifImagePlugin,
    JpegImagePlugin,
    PngImagePlugin,
    PpmImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
    features,
)

_PLUGINS = (
    JpegImagePlugin, PngImagePlugin, WebPImagePlugin, BmpImagePlugin, TiffImagePlugin, GifImagePlugin,
    PpmImagePlugin, *([AvifImagePlugin] if features.check("avif") else []),
)  # fmt: skip
FORMATS = tuple(plugin.__name__.rpartition(".")[2].removesuffix("ImagePlugin").upper() for plugin in _PLUGINS)
"""What is decoded. Pillow would also take formats that start other programs, as EPS does Ghostscript."""
SUFFIXES = (
    ".jpg", ".jpeg", ".jfif", ".jpe", ".png", ".webp", ".avif", ".bmp", ".tif", ".tiff", ".gif", ".ppm", ".pgm",
    ".heic", ".heif", ".hif",
)  # fmt: skip
"""Extensions that are looked for in folders, in lower case."""

_HEIC_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"}
"""What ISO/IEC 23008-12 calls files of HEVC pictures; the last two may hold others."""


def formats_of(data: bytes) -> tuple[str, ...]:
    """Return Pillow's names of the formats that a file may be opened as: HEIF only if it is one and can be read."""
    if not _is_heic(data) or importlib.util.find_spec("pillow_heif") is None:
        return FORMATS
    import pillow_heif

    pillow_heif.register_heif_opener(thumbnails=False)
    return (*FORMATS, "HEIF")


def why_unread(data: bytes) -> str:
    """Return a sentence on why a file could not be identified as one of :func:`formats_of`."""
    if not _is_heic(data):
        return "no image that can be read."
    if importlib.util.find_spec("pillow_heif") is None:
        return "HEIC is read with pillow-heif. Run pip install 'hudepth[heif]'."
    return "a HEIC that pillow-heif cannot read, truncated or damaged."


def _is_heic(data: bytes) -> bool:
    return data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS
