"""Decoding, the paths it may touch, and what it refuses."""

from __future__ import annotations

import os
import pickle
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from hudepth.base.errors import DataError
from hudepth.data.sources.files import PerProcess, csv_rows, inside, make_pair, read_depth, read_image

RGB = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).integers(0, 9999, (12, 20), dtype=np.uint16)


def encoded(extension: str, array: np.ndarray, *options: int) -> bytes:
    return cv2.imencode(extension, array, options)[1].tobytes()


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_claiming(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def message(error: pytest.ExceptionInfo[DataError]) -> str:
    return str(error.value)


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
    assert message(caught) == (f"'d.png': {channels} channels that differ are a picture, not depth. Store one channel.")


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


@pytest.mark.parametrize(("width", "height"), [(50_000, 50_000), (0, 12), (2**31, 1)])
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
    for data in (bytes(jpeg), tiff):
        with pytest.raises(DataError) as caught:
            read_depth(data, where="'a'")
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
    assert message(caught) == (f"'{path}': not a complete .npy array of plain numbers. Save it with numpy.save.")


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
        (np.zeros((2, 3, 1), np.float32), "float32 array of shape (2, 3, 1)"),
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


def test_unequal_sizes() -> None:
    with pytest.raises(DataError) as caught:
        make_pair(RGB, DEPTH[:8], image_where="'a.jpg'", depth_where="'a.png'")
    assert message(caught) == ("'a.jpg' is 20 x 12 pixels but 'a.png' is 20 x 8. Both must have one size.")


@pytest.mark.parametrize("name", ["a.png", "kitchen/a b.png", "..a/b..png", "./a.png"])
def test_paths_inside(tmp_path: Path, name: str) -> None:
    assert inside(tmp_path, name, where="index") == tmp_path / name


@pytest.mark.parametrize(
    "name",
    ["", "/etc/passwd", "..", "../a.png", "a/../../b.png", "a\\..\\b.png", "C:\\a.png", "C:a.png", "a\0.png"],
)
def test_paths_outside(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError) as caught:
        inside(tmp_path, name, where="'index.csv' line 2")
    assert message(caught) == (
        f"'index.csv' line 2: path {name!r} is not inside the data folder. Use paths relative to '{tmp_path}'."
    )


@pytest.mark.parametrize("data", [b"a,b\nc,d\n", b"a,b\r\nc,d\r\n", b"\xef\xbb\xbfa,b\n\nc,d"])
def test_csv_rows(data: bytes) -> None:
    assert [cells for _, cells in csv_rows(data, where="")] == [["a", "b"], ["c", "d"]]


def test_csv_lines_are_counted_with_blank_ones() -> None:
    assert csv_rows(b"a\n\nb\n", where="") == [(1, ["a"]), (3, ["b"])]


def test_csv_that_is_none() -> None:
    with pytest.raises(DataError, match=r"^'x': not a CSV file in UTF-8 \(.*\)\. Write it again\.$"):
        csv_rows(b"a,\xff\xfe", where="'x'")


def test_handle_opens_once_a_process_and_stays_behind(tmp_path: Path) -> None:
    handles: PerProcess[bytes] = PerProcess(Path.read_bytes)
    path = tmp_path / "a"
    path.write_bytes(b"1")
    assert handles.get(path) == b"1"
    path.write_bytes(b"2")
    assert handles.get(path) == b"1"
    assert pickle.loads(pickle.dumps(handles)).get(path) == b"2"


def test_handle_opens_again_after_a_fork(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    handles: PerProcess[bytes] = PerProcess(Path.read_bytes)
    path = tmp_path / "a"
    path.write_bytes(b"1")
    handles.get(path)
    path.write_bytes(b"2")
    monkeypatch.setattr(os, "getpid", lambda: -1)
    assert handles.get(path) == b"2"
