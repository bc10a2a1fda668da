"""What EXIF says of the camera: tiny JPEGs with each combination of tags."""

from __future__ import annotations

import io
import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, TiffImagePlugin

from hudepth.base.camera import Intrinsics
from hudepth.base.camera.exif import directory, exif_camera, number, orientation
from hudepth.base.images import read_photo

FOCAL, FILM, ZOOM, X, Y, UNIT, WIDE, HIGH = 0x920A, 0xA405, 0xA404, 0xA20E, 0xA20F, 0xA210, 0xA002, 0xA003
MODEL, ORIENTATION = 0x0110, 0x0112
DIAGONAL = math.hypot(60, 80)


def rational(over: float, under: int = 1000) -> TiffImagePlugin.IFDRational:
    return TiffImagePlugin.IFDRational(round(over * under), under)


def picture(tags: dict[int, Any], kind: str = "JPEG", size: tuple[int, int] = (80, 60), **first: Any) -> bytes:
    """A picture of (width, height) as stored; ``first`` has model and orientation."""
    exif = Image.Exif()
    for tag, value in {"model": MODEL, "orientation": ORIENTATION}.items():
        if tag in first:
            exif[value] = first[tag]
    exif.get_ifd(0x8769).update(tags)
    file = io.BytesIO()
    Image.new("RGB", size).save(file, kind, exif=exif)
    return file.getvalue()


def camera(data: bytes) -> Intrinsics:
    found = read_photo(data).camera
    assert isinstance(found, Intrinsics), found
    return found


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_the_focal_length_for_film_gives_pixels_also_after_rotation(turn: int, kind: str) -> None:
    found = camera(picture({FILM: 26}, kind, orientation=turn))
    assert (found.fx, found.fy) == pytest.approx((26 * DIAGONAL / 43.266615,) * 2)
    assert (found.cx, found.cy) == ((39.5, 29.5) if turn < 5 else (29.5, 39.5))
    assert found.known
    assert found.origin == "from EXIF, 26 mm on 35 mm film"


@pytest.mark.parametrize("turn", [1, 3, 6, 8])
@pytest.mark.parametrize(("unit", "per_mm"), [(None, 25.4), (2, 25.4), (3, 10), (4, 1), (5, 0.001)])
def test_millimetres_and_pixels_a_unit_of_the_sensor(unit: int | None, per_mm: float, turn: int) -> None:
    tags = {FOCAL: rational(4.2), X: rational(20 * per_mm, 10**6), Y: rational(22 * per_mm, 10**6)}
    found = camera(picture(tags if unit is None else {**tags, UNIT: unit}, orientation=turn))
    expected = (4.2 * 20, 4.2 * 22)
    assert (found.fx, found.fy) == pytest.approx(expected if turn < 5 else expected[::-1], rel=1e-3)
    assert found.origin.startswith("from EXIF, 4.2 mm, ")


def test_one_resolution_stands_for_both_and_a_smaller_copy_has_fewer_pixels() -> None:
    tags = {FOCAL: rational(4.2), X: rational(508), UNIT: 2}
    assert camera(picture(tags)).fy == pytest.approx(84)
    assert camera(picture({**tags, WIDE: 160, HIGH: 120})).fx == pytest.approx(42)
    assert camera(picture({**tags, WIDE: 120, HIGH: 160}, size=(60, 80))).fx == pytest.approx(42)
    assert camera(picture({**tags, ZOOM: rational(1.5)})).fx == pytest.approx(126)


@pytest.mark.parametrize(
    ("model", "millimetres"),
    [
        ("Canon EOS 5D Mark II", 36), ("Canon EOS 600D", 22.3), ("NIKON D850", 36), ("NIKON D70", 0),
        ("NIKON D5600", 23.5), ("ILCE-7M3", 35.8), ("ILCE-6400", 23.5), ("X-T30 II", 23.5), ("E-M10MarkIII", 17.3),
        ("DC-GX9", 17.3), ("iPhone 4", 4.54), ("iPhone 40", 0), ("", 0), ("Nokia 3310", 0),
    ],
)  # fmt: skip
def test_the_sensor_by_the_cameras_model(model: str, millimetres: float) -> None:
    data = picture({FOCAL: rational(25 if millimetres > 10 else 4)}, model=model)
    if not millimetres:
        assert read_photo(data).camera == "its EXIF states 4 mm, but not the sensor's size"
        return
    focal = (25 if millimetres > 10 else 4) * 80 / millimetres
    assert camera(data).fx == camera(data).fy == pytest.approx(focal)
    assert model in camera(data).origin


def test_film_goes_before_the_sensor_and_what_is_impossible_is_passed_over() -> None:
    sensor = {FOCAL: rational(4.2), X: rational(508), UNIT: 2}
    assert "film" in camera(picture({FILM: 26, **sensor})).origin
    assert camera(picture({FILM: 0, **sensor})).fx == pytest.approx(84)  # 0: unknown, says the standard
    assert camera(picture({FILM: 60_000, **sensor})).fx == pytest.approx(84)
    assert camera(picture({FOCAL: rational(25), X: rational(1e-3), UNIT: 2}, model="ILCE-6400")).fx == 25 * 80 / 23.5


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        ({}, ""),
        ({0x9000: b"0232"}, ""),
        ({FILM: 0}, "no possible focal length"),
        ({FILM: 65535}, "no possible focal length"),
        ({FILM: 1}, "no possible focal length"),
        ({FOCAL: rational(0)}, "no possible focal length"),
        ({FOCAL: rational(4.2)}, "4.2 mm, but not the sensor's size"),
        ({FOCAL: rational(4.2), X: rational(0)}, "not the sensor's size"),
        ({FOCAL: rational(4.2), X: rational(508), UNIT: 1}, "not the sensor's size"),
        ({FOCAL: rational(4.2), X: rational(508), UNIT: 77}, "not the sensor's size"),
        ({FOCAL: rational(4.2), X: rational(9), UNIT: 2}, "no possible focal length"),
        ({FOCAL: rational(4e6, 1), X: rational(508), UNIT: 2}, "no possible focal length"),
        ({FILM: 26, WIDE: 80, HIGH: 80}, "80 x 80 pixels: it was cropped"),
    ],
)
def test_nothing_or_nonsense_is_no_camera_and_says_why(tags: dict[int, Any], words: str) -> None:
    found = read_photo(picture(tags)).camera
    assert isinstance(found, str)
    assert words in found
    assert bool(found) == bool(words)


def block(tags: dict[int, tuple[int, int, bytes]], values: bytes = b"", *, pointer: int = 26) -> bytes:
    """EXIF by hand: a first directory with nothing but the pointer, then the tags at 26, then ``values``."""
    first = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x8769, 4, 1, pointer, 0)
    own = b"".join(struct.pack("<HHI4s", tag, kind, count, field) for tag, (kind, count, field) in tags.items())
    return first + struct.pack("<H", len(tags)) + own + bytes(4) + values


def test_fractions_over_zero_are_no_numbers() -> None:
    zero = block({FOCAL: (5, 1, struct.pack("<I", 44))}, struct.pack("<II", 42, 0))
    assert exif_camera(zero, 60, 80) == "its EXIF states no possible focal length (not a number)"
    good = block({FOCAL: (5, 1, struct.pack("<I", 44))}, struct.pack("<II", 42, 10))
    assert "4.2 mm, but not" in str(exif_camera(good, 60, 80))


@pytest.mark.parametrize("pointer", [0, 1, 8, 25, 27, 4000, 2**32 - 1])
def test_pointers_may_lead_anywhere(pointer: int) -> None:
    assert isinstance(exif_camera(block({FILM: (3, 1, b"\x1a\0\0\0")}, pointer=pointer), 60, 80), str)
    far = block({FOCAL: (5, 2**32 - 1, struct.pack("<I", pointer)), X: (5, 1, struct.pack("<I", pointer))})
    assert isinstance(exif_camera(far, 60, 80), str | Intrinsics)


@given(st.binary(max_size=80), st.binary(max_size=60), st.integers(0, 90))
def test_any_bytes_are_read_without_an_error(first: bytes, second: bytes, pointer: int) -> None:
    for data in (
        first,
        b"MM\0*" + first,
        b"II+\0" + first,
        block({FILM: (3, 1, b"\0\0\0\0")}, second, pointer=pointer),
    ):
        assert isinstance(exif_camera(data, 60, 80), str | Intrinsics)
        assert 1 <= orientation(data) <= 8
        for entry in directory(data).values():
            assert isinstance(number(data, entry), float)
