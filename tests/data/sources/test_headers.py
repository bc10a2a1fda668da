"""Size and completeness from the container: every file that is cut short is found."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import DataError
from hudepth.data.sources.files import read_depth, read_image
from hudepth.data.sources.headers import image_size

RGB = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).integers(0, 9999, (12, 20), dtype=np.uint16)


def encoded(extension: str, array: np.ndarray, *options: int) -> bytes:
    return cv2.imencode(extension, array, options)[1].tobytes()


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def message(error: pytest.ExceptionInfo[DataError]) -> str:
    return str(error.value)


@pytest.mark.parametrize("progressive", [0, 1])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.9, 0.99])
def test_truncated_jpeg(share: float, progressive: int) -> None:
    data = encoded(".jpg", RGB.repeat(8, 0).repeat(8, 1), cv2.IMWRITE_JPEG_PROGRESSIVE, progressive)
    with pytest.raises(DataError) as caught:
        read_image(data[: int(len(data) * share)], where="'a.jpg'")
    assert message(caught) == "'a.jpg': the JPEG is truncated (JPEG data without its end). Copy the file again."


def test_end_marker_inside_a_thumbnail_does_not_hide_truncation() -> None:
    plain = encoded(".jpg", RGB)
    thumbnail = b"Exif\0\0" + plain
    data = plain[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + plain[2:]
    np.testing.assert_array_equal(read_image(data), read_image(plain))
    with pytest.raises(DataError, match="the JPEG is truncated"):
        read_image(data[:-40])


@pytest.mark.parametrize("tail", [b"\0" * 100, b"garbage \xff\xd8", b"\xff"])
def test_jpeg_with_a_tail_is_complete(tail: bytes) -> None:
    plain = encoded(".jpg", RGB)
    np.testing.assert_array_equal(read_image(plain + tail), read_image(plain))


@given(share=st.floats(0.001, 0.999))
def test_truncated_png(share: float) -> None:
    data = encoded(".png", DEPTH)
    with pytest.raises(DataError) as caught:
        read_depth(data[: max(8, int(len(data) * share))], where="'a.png'")
    assert message(caught) == "'a.png': the PNG is truncated (PNG data without its end). Copy the file again."


def test_damaged_png() -> None:
    data = bytearray(encoded(".png", DEPTH))
    data[len(data) // 2] ^= 0xFF
    with pytest.raises(DataError) as caught:
        read_depth(bytes(data), where="'a.png'")
    assert message(caught) == "'a.png': the PNG is damaged (checksum of chunk b'IDAT'). Copy the file again."


def test_png_without_header() -> None:
    with pytest.raises(DataError) as caught:
        read_depth(b"\x89PNG\r\n\x1a\n" + chunk(b"IEND", b""), where="'a.png'")
    assert message(caught) == "'a.png': the PNG is damaged (it has no header). Copy the file again."


@pytest.mark.parametrize("share", [0.01, 0.5, 0.99])
def test_truncated_tiff(share: float) -> None:
    data = encoded(".tif", DEPTH)
    with pytest.raises(DataError, match=r"^'a.tif': "):
        read_depth(data[: max(5, int(len(data) * share))], where="'a.tif'")


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"", "an empty file"),
        (b"GIF89a  ", "a file that begins with b'GIF89a  '"),
        (b"\x93NUMPY\x01\x00", "a file that begins with b'\\x93NUMPY\\x01\\x00'"),
    ],
)
def test_other_kinds_of_file(data: bytes, found: str) -> None:
    with pytest.raises(DataError) as caught:
        read_image(data, where="'a'")
    assert message(caught) == f"'a': neither PNG, JPEG nor TIFF but {found}. Replace it."


@given(data=st.binary(max_size=64), start=st.sampled_from([b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0"]))
def test_noise_is_refused_with_an_error_of_ours(data: bytes, start: bytes) -> None:
    with pytest.raises(DataError):
        read_depth(start + data)


@pytest.mark.parametrize("extension", [".png", ".jpg", ".tif"])
@pytest.mark.parametrize("shape", [(12, 20), (1, 1), (300, 7)])
def test_image_size_is_the_decoders(extension: str, shape: tuple[int, int]) -> None:
    assert image_size(encoded(extension, np.zeros(shape, np.uint8)), where="") == shape
