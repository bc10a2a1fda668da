"""Decoding, and the checks before it: truncated, damaged and oversized files are refused."""

from __future__ import annotations

import io
import os
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from hudepth.base.errors import DataError
from hudepth.base.images import read_photo
from hudepth.data.sources.decoding import image_size, read_depth, read_image

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
    assert message(caught).startswith("'a.jpg': the JPEG is truncated or damaged (")


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
    assert message(caught).startswith("'a.png': the PNG is truncated or damaged (")


def test_damaged_png() -> None:
    data = bytearray(encoded(".png", DEPTH))
    data[len(data) // 2] ^= 0xFF
    with pytest.raises(DataError) as caught:
        read_depth(bytes(data), where="'a.png'")
    assert message(caught).startswith("'a.png': the PNG is truncated or damaged (")


def test_png_without_header() -> None:
    with pytest.raises(DataError) as caught:
        read_depth(b"\x89PNG\r\n\x1a\n" + chunk(b"IEND", b""), where="'a.png'")
    assert message(caught).startswith("'a.png': the PNG is truncated or damaged (")


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


def png_claiming(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def test_png_is_rgb() -> None:
    np.testing.assert_array_equal(read_image(encoded(".png", RGB[..., ::-1])), RGB)


def test_jpeg_is_rgb() -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 250
    image = read_image(encoded(".jpg", red[..., ::-1]))
    assert np.abs(image.astype(int) - red).max() <= 3
    assert image.dtype == np.uint8


def test_grey_transparent_and_16_bit_images_become_8_bit_rgb() -> None:
    grey = RGB[..., 0]
    np.testing.assert_array_equal(read_image(encoded(".png", grey)), np.dstack([grey] * 3))
    rgba = np.dstack([RGB[..., ::-1], grey])
    np.testing.assert_array_equal(read_image(encoded(".png", rgba)), RGB)
    wide = RGB.astype(np.uint16)[..., ::-1] * 257
    np.testing.assert_array_equal(read_image(encoded(".png", wide)), RGB)


def test_orientation_tag_is_not_applied() -> None:
    plain = encoded(".jpg", RGB)
    tag = struct.pack(">HHIHH", 0x0112, 3, 1, 6, 0)  # orientation 6: turn by 90 degrees
    exif = b"Exif\0\0MM\0*" + struct.pack(">IH", 8, 1) + tag + b"\0\0\0\0"
    turned = plain[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + plain[2:]
    decoded = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert decoded.shape == (20, 12, 3)  # OpenCV itself turns it
    np.testing.assert_array_equal(read_image(turned), read_image(plain))


@pytest.mark.parametrize(
    ("extension", "depth"),
    [
        (".png", DEPTH),
        (".png", DEPTH.astype(np.uint8)),
        (".tif", DEPTH),
        (".tif", DEPTH.astype(np.float32) / 7),
        (".tiff", DEPTH.astype(np.float64) / 7),
    ],
)
def test_depth_values_are_kept(tmp_path: Path, extension: str, depth: np.ndarray) -> None:
    path = tmp_path / f"d{extension}"
    path.write_bytes(encoded(extension, depth))
    raw = read_depth(path)
    assert raw.dtype == depth.dtype
    np.testing.assert_array_equal(raw, depth)


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<u2", ">u2", "f2", "i4"])
def test_npy_is_kept_in_native_order(tmp_path: Path, dtype: str) -> None:
    np.save(tmp_path / "d.NPY.npy", np.asfortranarray(DEPTH.astype(dtype)))
    raw = read_depth(tmp_path / "d.NPY.npy")
    assert raw.dtype == np.dtype(dtype).newbyteorder("=")
    assert type(raw) is np.ndarray  # not a memory map, which would hold the file open
    np.testing.assert_array_equal(raw, DEPTH.astype(dtype))


def test_depth_saved_as_grey_colour_is_one_channel() -> None:
    np.testing.assert_array_equal(read_depth(encoded(".png", np.dstack([DEPTH] * 3))), DEPTH)


@pytest.mark.parametrize("channels", [3, 4])
def test_colour_is_no_depth(channels: int) -> None:
    picture = np.dstack([RGB, RGB[..., 0]])[..., :channels]
    with pytest.raises(DataError) as caught:
        read_depth(encoded(".png", picture), where="'d.png'")
    assert message(caught).startswith(f"'d.png': {channels} channels of uint8 that differ are a picture")


def test_missing_file(tmp_path: Path) -> None:
    for name, read in (("a.jpg", read_image), ("a.png", read_depth), ("a.npy", read_depth)):
        with pytest.raises(DataError) as caught:
            read(tmp_path / name)
        assert message(caught) == f"no file '{tmp_path / name}'. Copy it there, or take it off the list."


def test_png_whose_pixels_are_missing() -> None:
    with pytest.raises(DataError) as caught:
        read_depth(png_claiming(20, 12), where="'a.png'")
    assert message(caught) == "'a.png': cannot be decoded, the file is damaged. Copy the file again."


def test_tiff_is_no_image() -> None:
    with pytest.raises(DataError) as caught:
        read_image(encoded(".tif", DEPTH), where="'a.tif'")
    assert message(caught) == "'a.tif': a TIFF cannot be the image of a pair. Store images as JPEG or PNG."


@pytest.mark.parametrize(("width", "height"), [(50_000, 50_000), (2**31, 1)])
def test_size_is_checked_before_decoding(monkeypatch: pytest.MonkeyPatch, width: int, height: int) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(DataError) as caught:
        read_image(png_claiming(width, height), where="'a.png'")
    assert message(caught) == (f"'a.png': {width} x {height} pixels, allowed are 1 to 100 million. Resize the file.")


def test_jpeg_and_tiff_sizes_are_checked_before_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    jpeg = bytearray(encoded(".jpg", RGB))
    at = jpeg.index(b"\xff\xc0") + 5
    jpeg[at : at + 4] = struct.pack(">HH", 60_000, 50_000)
    tiff = struct.pack("<2sHIHHHIIHHII", b"II", 42, 8, 2, 256, 4, 1, 50_000, 257, 4, 1, 60_000)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    for data, read in ((bytes(jpeg), read_image), (tiff, read_depth)):
        with pytest.raises(DataError) as caught:
            read(data, where="'a'")
        assert message(caught) == "'a': 50000 x 60000 pixels, allowed are 1 to 100 million. Resize the file."


def npy(path: Path, header: str, body: bytes = b"") -> Path:
    text = header.encode()
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body)
    return path


def test_npy_never_unpickles(tmp_path: Path) -> None:
    path = tmp_path / "d.npy"
    np.save(path, np.array([[{"a": 1}]], dtype=object))
    with pytest.raises(DataError) as caught:
        read_depth(path)
    assert message(caught) == f"'{path}': holds Python objects. Save the depth array inside with numpy.save."


def test_npy_size_is_checked_before_reading(tmp_path: Path) -> None:
    path = npy(tmp_path / "d.npy", "{'descr': '|u1', 'fortran_order': False, 'shape': (20000, 6000)}\n")
    os.truncate(path, path.stat().st_size + 20000 * 6000)  # sparse: takes no disk
    with pytest.raises(DataError) as caught:
        read_depth(path)
    assert message(caught) == f"'{path}': 6000 x 20000 pixels, allowed are 1 to 100 million. Resize the file."


@pytest.mark.filterwarnings("ignore:overflow encountered")
@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 4)}\n",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-4, 4)}\n",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999, 9999999999999)}\n",
        "{'descr': '<f4', 'shape': (4, 4)}\n",
        "no header\n",
        "(((((",  # tokenize.TokenError
        "-" * 9000,  # MemoryError or RecursionError
    ],
)
def test_damaged_npy(tmp_path: Path, header: str) -> None:
    path = npy(tmp_path / "d.npy", header, b"\0" * 8)
    with pytest.raises(DataError) as caught:
        read_depth(path)
    assert message(caught) == (f"'{path}': not a complete .npy array of plain numbers. Save it with numpy.save.")


def test_npz_under_another_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "d.npz", DEPTH)
    (tmp_path / "d.npz").rename(tmp_path / "d.npy")
    with pytest.raises(DataError, match="not a complete"):
        read_depth(tmp_path / "d.npy")


@pytest.mark.parametrize(
    ("array", "found"),
    [
        (np.zeros((2, 3, 2), np.float32), "float32 array of shape (2, 3, 2)"),
        (np.zeros((2, 3), bool), "a mask"),
        (np.zeros((2, 3), np.complex64), "complex64 array of shape (2, 3)"),
    ],
)
def test_npy_of_another_form(tmp_path: Path, array: np.ndarray, found: str) -> None:
    path = tmp_path / "d.npy"
    np.save(path, array)
    with pytest.raises(DataError) as caught:
        read_depth(path)
    assert message(caught) == f"'{path}': {found}. Save one number per pixel, as [H, W]."


def test_huge_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.touch()
    os.truncate(path, (1 << 30) + 1)
    with pytest.raises(DataError) as caught:
        read_depth(path)
    assert message(caught) == f"'{path}': larger than 1024 MiB. It cannot be one depth map or list."


def test_png_of_no_pixels() -> None:
    with pytest.raises(DataError, match="damaged"):
        read_image(png_claiming(0, 12))


def test_hostile_exif_is_not_read() -> None:
    """Each of 5,000 tags claims the same 60,000 bytes: 300 MB, if their values were read."""
    tags = b"".join(struct.pack(">HHII", tag, 7, 60_000, 0) for tag in range(1, 5001))
    exif = b"Exif\0\0MM\0*" + struct.pack(">IH", 8, 5000) + tags + b"\0\0\0\0"
    plain = encoded(".jpg", RGB)
    tracemalloc.start()
    size = image_size(plain[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + plain[2:], where="")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert size == RGB.shape[:2]
    assert peak < 2_000_000


@pytest.mark.parametrize("shape", [(1, 5, 7), (5, 7, 1)])
def test_npy_with_an_axis_of_one(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "d.npy", DEPTH.reshape(-1)[:35].reshape(shape))
    np.testing.assert_array_equal(read_depth(tmp_path / "d.npy"), DEPTH.reshape(-1)[:35].reshape(5, 7))


@pytest.mark.parametrize("order", ["<", ">"])
def test_pfm(order: str) -> None:
    depth = np.linspace(1, 4, 12).reshape(3, 4)
    data = b"Pf\n4 3\n%d.0\n" % (-1 if order == "<" else 1) + depth[::-1].astype(f"{order}f4").tobytes()
    np.testing.assert_array_equal(read_depth(data), depth.astype(np.float32))
    for damaged in (data[:-1], b"PF" + data[2:], data.replace(b"4 3", b"x 3")):
        with pytest.raises(DataError, match="PFM"):
            read_depth(damaged)


def png_of(rows: np.ndarray, kind: int, bits: int, palette: bytes = b"") -> bytes:
    height, width = rows.shape[:2]
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0))
    pixels = chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows)))
    colours = chunk(b"PLTE", palette) if palette else b""
    return b"\x89PNG\r\n\x1a\n" + header + colours + pixels + chunk(b"IEND", b"")


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_upright_images_are_those_that_the_reader_of_photos_does_not_turn(kind: str, turn: int) -> None:
    exif, buffer = Image.Exif(), io.BytesIO()
    exif[0x0112] = turn
    Image.fromarray(RGB).save(buffer, kind, exif=exif)
    data = buffer.getvalue()
    stored, photo = read_image(data), read_photo(data).rgb
    if turn == 1:
        np.testing.assert_array_equal(read_image(data, upright=True), stored)
        assert photo.shape == stored.shape
        return
    with pytest.raises(DataError) as caught:
        read_image(data, where="'a'", upright=True)
    assert message(caught).startswith(f"'a': EXIF orientation {turn}, so its depth may be upright")
    assert photo.shape != stored.shape or np.abs(photo.astype(int) - stored).mean() > 20


def test_grey_with_alpha_or_a_palette() -> None:
    grey = np.arange(1, 13, dtype=np.uint8).reshape(3, 4)
    alpha = np.where(grey == 5, 0, 255).astype(np.uint8)
    found = read_depth(png_of(np.dstack([grey, alpha]), 4, 8))
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, np.where(grey == 5, 0, grey))
    np.testing.assert_array_equal(read_depth(png_of(grey, 3, 8, bytes(np.repeat(np.arange(256), 3).tolist()))), grey)
    with pytest.raises(DataError, match="alpha"):
        read_depth(png_of(np.dstack([grey, alpha]).astype(">u2"), 4, 16))
    with pytest.raises(DataError, match="picture"):
        read_depth(png_of(grey, 3, 8, bytes(i * 7 % 256 for i in range(768))))


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (b"v/1\x01" + bytes(100), "OpenEXR"),
        (png_of(np.zeros((2, 4), np.uint8), 0, 4), "4 bits"),
        (b"PK\x03\x04" + bytes(30), "npz"),
        (encoded(".jpg", DEPTH >> 8), "JPEG"),
    ],
)
def test_kinds_that_are_not_read_are_named(data: bytes, word: str) -> None:
    with pytest.raises(DataError, match=f"'a': .*{word}"):
        read_depth(data, where="'a'")


def tiff(depth: np.ndarray, *, order: str, big: bool, compression: int = 1, more: bytes = bytes(8)) -> bytes:
    """Write one strip, with its directory behind it."""
    kind = {"u": 1, "i": 2, "f": 3}[depth.dtype.kind]
    pixels = depth.astype(depth.dtype.newbyteorder(order)).tobytes()
    head = struct.pack(f"{order}HHHQ", 43, 8, 0, 16 + len(pixels)) if big else b""
    head = head or struct.pack(f"{order}HI", 42, 8 + len(pixels))
    strip = 16 if big else 8
    tags = {256: depth.shape[1], 257: depth.shape[0], 258: 8 * depth.itemsize, 259: compression, 262: 1, 273: strip}
    tags |= {277: 1, 278: depth.shape[0], 279: len(pixels), 339: kind}
    entries = b"".join(
        struct.pack(f"{order}HHQQ", tag, 16, 1, value) if big else struct.pack(f"{order}HHII", tag, 4, 1, value)
        for tag, value in tags.items()
    )
    count = struct.pack(f"{order}{'Q' if big else 'H'}", len(tags))
    return (b"II" if order == "<" else b"MM") + head + pixels + count + entries + (more if big else more[:4])


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", ["u2", "i2", "u4", "i4", "f4", "f8"])
def test_tiffs(dtype: str, order: str, big: bool) -> None:
    depth = np.linspace(1, 4000, 12).reshape(3, 4).astype(dtype)
    np.testing.assert_array_equal(read_depth(tiff(depth, order=order, big=big)), depth)


def test_tiffs_that_are_not_read_say_what_they_hold() -> None:
    depth = np.ones((3, 4), np.float16)
    with pytest.raises(DataError, match="16-bit float, compression 1, predictor 1"):
        read_depth(tiff(depth, order="<", big=False))
    with pytest.raises(DataError, match="compression 50000"):
        read_depth(tiff(depth.astype("u2"), order="<", big=False, compression=50000))
    with pytest.raises(DataError, match="several pages"):
        read_depth(tiff(depth.astype("u2"), order="<", big=False, more=b"\x08\0\0\0"))
