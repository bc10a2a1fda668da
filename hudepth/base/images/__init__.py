"""Photographs as people have them, decoded to upright RGB; and what is refused before that."""

from hudepth.base.images.files import MAX_NATIVE_PIXELS, MAX_PIXELS, check_file, check_pixels, read_bytes
from hudepth.base.images.formats import FORMATS, SUFFIXES
from hudepth.base.images.photo import Photo, as_rgb, pillow_rgb, read_photo, resize_image

__all__ = [
    "FORMATS", "MAX_NATIVE_PIXELS", "MAX_PIXELS", "SUFFIXES", "Photo", "as_rgb", "check_file", "check_pixels",
    "pillow_rgb", "read_bytes", "read_photo", "resize_image",
]  # fmt: skip
