"""Pictures as people have them, and as strangers make them."""

from __future__ import annotations

import io
import math
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, features

from hudepth.base.camera import Intrinsics
from hudepth.base.errors import DataError
from hudepth.base.images import as_rgb, read_photo

RGB = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)
SMOOTH = np.stack(np.broadcast_arrays(np.arange(120)[:, None], np.arange(200), 90), axis=-1).astype(np.uint8)


def encoded(image: Image.Image, kind: str = "PNG", **options: object) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


@pytest.mark.parametrize("kind", ["PNG", "BMP", "TIFF", "PPM", "GIF", "WEBP", "JPEG"])
def test_formats(kind: str) -> None:
    data = encoded(Image.fromarray(RGB), kind, **({"lossless": True} if kind == "WEBP" else {}))
    photo = read_photo(data)
    assert photo.rgb.shape == (12, 20, 3)
    assert photo.rgb.dtype == np.uint8
    if kind in ("PNG", "BMP", "TIFF", "PPM", "WEBP"):
        assert (photo.rgb == RGB).all()
    assert photo.notes == ()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_orientation_tag_is_honoured(orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    upright = read_photo(encoded(Image.fromarray(RGB), exif=exif)).rgb
    turned = {  # EXIF 2.32, orientation: what brings the stored picture upright
        1: RGB, 2: RGB[:, ::-1], 3: RGB[::-1, ::-1], 4: RGB[::-1], 5: RGB.transpose(1, 0, 2),
        6: np.rot90(RGB, -1), 7: RGB.transpose(1, 0, 2)[::-1, ::-1], 8: np.rot90(RGB),
    }[orientation]  # fmt: skip
    assert (upright == turned).all()


def test_grey_and_16_bit_and_palette_and_cmyk() -> None:
    grey = RGB[..., 0]
    assert (read_photo(encoded(Image.fromarray(grey))).rgb == grey[..., None]).all()
    deep = grey.astype(np.uint16) * 257
    for kind in ("PNG", "TIFF"):
        assert (read_photo(encoded(Image.fromarray(deep), kind)).rgb == grey[..., None]).all()
    palette = Image.fromarray(RGB).quantize(8)
    assert (read_photo(encoded(palette)).rgb == np.asarray(palette.convert("RGB"))).all()
    plain = Image.new("RGB", (8, 8), (200, 30, 30))
    cmyk = read_photo(encoded(plain.convert("CMYK"), "JPEG")).rgb
    assert np.abs(cmyk.astype(int) - (200, 30, 30)).max() < 6


def test_what_is_transparent_is_white() -> None:
    rgba = np.dstack([RGB, np.zeros(RGB.shape[:2], np.uint8)])
    rgba[:, 10:, 3] = 255
    for picture in (read_photo(encoded(Image.fromarray(rgba))).rgb, as_rgb(rgba)):
        assert (picture[:, :10] == 255).all()
        assert (picture[:, 10:] == RGB[:, 10:]).all()


def test_of_an_animation_the_first_frame_is_taken_and_said_so() -> None:
    frames = [Image.new("RGB", (8, 6), colour) for colour in ("red", "blue", "lime")]
    photo = read_photo(encoded(frames[0], "GIF", save_all=True, append_images=frames[1:]))
    assert photo.notes == ("animated, 3 frames: the first is taken",)
    assert tuple(photo.rgb[0, 0]) == (255, 0, 0)


def bomb(width: int, height: int) -> bytes:
    """A small PNG whose header claims many pixels."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    data = zlib.compress(bytes(1_000_000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


JPEG = encoded(Image.fromarray(np.tile(RGB, (10, 10, 1))), "JPEG")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "x.png: the file is empty (0 bytes). Copy it again."),
        (b"hello, I am a text", "x.png: no image that can be read. Pass a JPEG, PNG, WEBP, BMP, TIFF, GIF, PPM"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "x.png: no image that can be read"),
        (JPEG[: len(JPEG) // 2], "x.png: cannot be decoded, the file is truncated or damaged ("),
        (JPEG[:60], "x.png: "),
        (encoded(Image.fromarray(RGB))[:-30], "x.png: cannot be decoded, the file is truncated or damaged ("),
        (bomb(10_001, 10_000), "x.png: 10001 x 10000 pixels, allowed are 1 to 100 million. Resize the file."),
        (bomb(20_000, 20_000), "x.png: more pixels than are decoded here. Resize the file."),
        (bomb(2**31 - 1, 2**31 - 1), "x.png: more pixels than are decoded here. Resize the file."),
        (encoded(Image.fromarray(np.ones((4, 4), np.float32)), "TIFF"), "x.png: floating-point pixels have no known"),
    ],
    ids=["empty", "text", "eps", "half", "head", "png", "large", "huge", "absurd", "float"],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_bad_files_are_one_line(data: bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught:
        read_photo(data, where="x.png")
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)
    (tmp_path / "y.png").write_bytes(data)
    with pytest.raises(DataError, match=re.escape(f"'{tmp_path / 'y.png'}': ")):
        read_photo(tmp_path / "y.png")


def test_a_file_that_is_not_there() -> None:
    with pytest.raises(DataError, match=r"no file 'nowhere\.jpg'"):
        read_photo("nowhere.jpg")


@pytest.mark.parametrize(
    "array", [np.zeros((3, 4, 2), np.uint8), np.zeros((3, 4, 3), np.float32), np.zeros(5, np.uint8)]
)
def test_arrays_that_are_no_image(array: np.ndarray) -> None:
    with pytest.raises(DataError, match=r"image: an array of .* and shape .* Pass RGB as uint8"):
        as_rgb(array)


def tagged(tags: int, length: int, *, orientation: int = 6) -> bytes:
    """An EXIF block whose tags all lie over the same ``length`` bytes."""
    entries = struct.pack("<HHII", 0x0112, 3, 1, orientation)
    entries += b"".join(struct.pack("<HHII", 0x9000 + n, 7, length, 100) for n in range(tags))
    return b"II*\0" + struct.pack("<IH", 8, tags + 1) + entries + bytes(max(length, 20))


def jpeg_with(*blocks: bytes) -> bytes:
    segments = [b"\xff\xe1" + struct.pack(">H", len(block) + 8) + b"Exif\0\0" + block for block in blocks]
    return JPEG[:2] + b"".join(segments) + JPEG[2:]


def test_one_tag_is_read_of_exif() -> None:
    assert read_photo(jpeg_with(tagged(2, 8))).rgb.shape == (200, 120, 3)
    assert read_photo(jpeg_with(b"MM\0*" + bytes(3))).rgb.shape == (120, 200, 3)
    assert read_photo(jpeg_with(tagged(1, 8, orientation=77))).rgb.shape == (120, 200, 3)


@pytest.mark.parametrize(
    "data",
    [
        jpeg_with(tagged(3000, 20_000)), jpeg_with(*[tagged(0, 60_000)] * 30), tagged(5000, 10_000_000),
        b"\0\0\0\x18ftypavif" + bytes(40) + tagged(5000, 1_000_000) + bytes(1_000_000),
    ],
    ids=["jpeg", "segments", "tiff", "avif"],
)  # fmt: skip
def test_tags_cannot_fill_the_memory(data: bytes) -> None:
    with pytest.raises(DataError, match=r"x\.jpg: .*EXIF"):
        read_photo(data, where="x.jpg")


def test_avif_is_read() -> None:
    if features.check("avif"):
        photo = read_photo(encoded(Image.fromarray(SMOOTH), "AVIF", quality=95))
        assert np.abs(photo.rgb.astype(int) - SMOOTH).mean() < 3


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


def heic_with(copies: int, length: int) -> bytes:
    """A HEIC whose EXIF items all lie over the same ``length`` bytes."""
    data = encoded(Image.new("RGB", (64, 64), (9, 99, 9)), "HEIF")
    at, parts = 0, {}
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        parts[kind] = data[at + 8 : at + size]
        at += size
    at, inner = 4, {}
    while at < len(parts[b"meta"]):
        size, kind = struct.unpack_from(">I4s", parts[b"meta"], at)
        inner[kind] = parts[b"meta"][at + 8 : at + size]
        at += size
    numbers = range(2, 2 + copies)
    infos = [inner[b"iinf"][6:], *(box(b"infe", struct.pack(">IHH4sx", 2 << 24, n, 0, b"Exif")) for n in numbers)]
    inner[b"iinf"] = struct.pack(">IH", 0, len(infos)) + b"".join(infos)
    inner[b"iref"] = bytes(4) + b"".join(box(b"cdsc", struct.pack(">HHH", n, 1, 1)) for n in numbers)
    for _ in range(2):  # the first time for its size
        start = 16 + len(parts[b"ftyp"]) + sum(8 + len(each) for each in inner.values()) + 4 + 8
        places = [(1, start, len(parts[b"mdat"])), *((n, start + len(parts[b"mdat"]), length) for n in numbers)]
        rows = b"".join(struct.pack(">HHHII", number, 0, 1, offset, size) for number, offset, size in places)
        inner[b"iloc"] = struct.pack(">IBBH", 0, 0x44, 0, len(places)) + rows
    meta = box(b"meta", bytes(4) + b"".join(box(kind, content) for kind, content in inner.items()))
    exif = b"\0\0\0\x06Exif\0\0II*\0" + bytes(length - 14)
    return box(b"ftyp", parts[b"ftyp"]) + meta + box(b"mdat", parts[b"mdat"] + exif)


@pytest.fixture
def heif() -> None:
    """Where pillow-heif is installed, it writes HEIC, too."""
    pytest.importorskip("pillow_heif", reason="pillow-heif is not installed").register_heif_opener()


def camera_exif(orientation: int) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769)[0xA405] = 26  # FocalLengthIn35mmFilm
    return exif.tobytes()


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
@pytest.mark.usefixtures("heif")
def test_heic_is_read_upright_with_its_camera(orientation: int, turns: int) -> None:
    photo = read_photo(encoded(Image.fromarray(SMOOTH), "HEIF", quality=95, exif=camera_exif(orientation)))
    upright = np.rot90(SMOOTH, turns).astype(int)
    assert photo.rgb.shape == upright.shape
    assert np.abs(photo.rgb - upright).mean() < 3
    assert isinstance(photo.camera, Intrinsics)
    assert photo.camera.fx == pytest.approx(26 * math.hypot(120, 200) / math.hypot(36, 24))
    assert photo.notes == ()


@pytest.mark.usefixtures("heif")
def test_heic_has_the_same_limits() -> None:
    data = encoded(Image.fromarray(SMOOTH), "HEIF")
    assert read_photo(data, where="x.heic").rgb.shape == (120, 200, 3)
    with pytest.raises(DataError, match=r"x\.heic: 200 x 120 pixels, allowed are 1 to 0\.02 million"):
        read_photo(data, where="x.heic", max_pixels=20_000)
    at = data.index(b"ispe") + 8  # states fewer pixels than there are
    with pytest.raises(DataError, match=r"x\.heic: "):
        read_photo(data[:at] + struct.pack(">II", 20, 12) + data[at + 8 :], where="x.heic", max_pixels=20_000)
    for cut in (12, 40, len(data) // 2, len(data) - 9):
        with pytest.raises(DataError, match=r"x\.heic: (a HEIC that pillow-heif cannot read|.*truncated or damaged)"):
            read_photo(data[:cut], where="x.heic")


@pytest.mark.usefixtures("heif")
def test_items_of_a_heic_cannot_fill_the_memory() -> None:
    assert read_photo(heic_with(3, 5000)).rgb.shape == (64, 64, 3)
    with pytest.raises(DataError, match=r"x\.heic: its tags .EXIF. overlap"):
        read_photo(heic_with(50, 100_000), where="x.heic")
    endless = box(b"ftyp", b"heic" + bytes(8)) + box(b"meta", bytes(4) + box(b"iloc", b"\2" + b"\0" * 5 + b"\xff" * 99))
    with pytest.raises(DataError, match=r"x\.heic: "):
        read_photo(endless, where="x.heic")


def test_heic_without_pillow_heif_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(DataError, match=r"x\.heic: HEIC is read with pillow-heif\. Run pip install 'hudepth\[heif\]'"):
        read_photo(b"\0\0\0\x18ftypheic" + bytes(40), where="x.heic")
    with pytest.raises(DataError, match=r"x\.jpg: no image that can be read\. Pass a JPEG"):
        read_photo(b"\0\0\0\x18ftypisom" + bytes(40), where="x.jpg")
