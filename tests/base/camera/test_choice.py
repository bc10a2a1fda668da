"""The option ``camera=``."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.camera import CameraChoice, CameraOption, Intrinsics
from hudepth.base.errors import ConfigError
from hudepth.base.options import convert

sides = st.integers(2, 5000)


@given(sides, sides, st.floats(20, 100))
def test_a_field_of_view_is_the_angle_between_the_outer_edges(height: int, width: int, degrees: float) -> None:
    degrees = round(degrees, 3)
    focal = width / 2 / math.tan(math.radians(degrees) / 2)
    if not 0.2 * max(height, width) <= focal <= 10 * max(height, width):
        return
    camera = CameraChoice.of(f"fov={degrees}").of_picture(height, width)
    assert camera is not None
    left, right = (-0.5 - camera.cx) / camera.fx, (width - 0.5 - camera.cx) / camera.fx
    assert math.degrees(math.atan(right) - math.atan(left)) == pytest.approx(degrees)
    assert camera.fx == camera.fy
    assert (camera.cx, camera.cy) == ((width - 1) / 2, (height - 1) / 2)


@given(sides, sides, st.floats(15, 200))
def test_35_mm_film_has_the_same_diagonal_field_of_view(height: int, width: int, millimetres: float) -> None:
    choice = CameraChoice.of(f"f35={millimetres:.4f}")
    focal = round(millimetres, 4) * math.hypot(height, width) / 43.266615
    if not 0.2 * max(height, width) <= focal <= 10 * max(height, width):
        with pytest.raises(ConfigError, match="camera"):
            choice.of_picture(height, width)
        return
    camera = choice.of_picture(height, width)
    assert camera is not None
    assert math.hypot(height, width) / 2 / camera.fx == pytest.approx(math.hypot(36, 24) / 2 / round(millimetres, 4))


def test_a_focal_length_in_pixels_and_numbers_and_matrices() -> None:
    pixels = CameraChoice.of("f=60").of_picture(48, 64)
    assert pixels is not None
    assert pixels.numbers == (60, 60, 31.5, 23.5)
    assert pixels.origin == "as given, f=60"
    matrix = np.array([[60, 0, 32], [0, 61, 24], [0, 0, 1]])
    for camera in ((60, 61, 32, 24), [60.0, 61.0, 32.0, 24.0], matrix, Intrinsics(60, 61, 32, 24)):
        found = CameraChoice.of(camera).of_picture(48, 64)
        assert found is not None
        assert found.numbers == (60, 61, 32, 24)


def test_auto_is_what_exif_states_and_training_is_not() -> None:
    stated = Intrinsics(60, 60, 31.5, 23.5)
    assert CameraChoice.of("auto").of_picture(48, 64, stated) is stated
    assert CameraChoice.of("auto").of_picture(48, 64, "its EXIF is no use") is None
    assert CameraChoice.of("training").of_picture(48, 64, stated) is None
    given = CameraChoice.of("f=60").of_picture(48, 64, Intrinsics(99, 99, 31.5, 23.5))
    assert given is not None
    assert given.fx == 60


@pytest.mark.parametrize(
    "option",
    [
        "",
        "fov",
        "fov=",
        "fov=0",
        "fov=150",
        "fov=3",
        "f35=6",
        "f35=900",
        "fov=nan",
        "f35=1",
        "f=0",
        "f=1e9",
        "26mm",
        "62",
        "auto,",
        "nyu",
    ],
)
def test_what_is_no_camera_is_said_with_what_is(option: str) -> None:
    with pytest.raises(ConfigError, match=r"^camera: .*fov=<degrees>"):
        CameraChoice.of(option)


@pytest.mark.parametrize("option", ["f=5", "f=900"])
def test_a_camera_that_cannot_have_taken_this_picture(option: str) -> None:
    with pytest.raises(ConfigError, match=r"^camera: .*64 x 48"):
        CameraChoice.of(option).of_picture(48, 64)


def test_a_field_of_view_that_a_portrait_cannot_have_is_named() -> None:
    assert CameraChoice.of("fov=134").of_picture(48, 64) is not None
    with pytest.raises(ConfigError, match=r"^camera: fov=134 cannot be of a picture of 48 x 64, .* 10 pixels"):
        CameraChoice.of("fov=134").of_picture(64, 48)


@pytest.mark.parametrize("value", [[1, 2, 3], True, None, {"fov": 62}])
def test_the_option_takes_words_and_four_numbers(value: object) -> None:
    assert convert("camera", [1, 2, 3, 4], CameraOption) == (1.0, 2.0, 3.0, 4.0)
    assert convert("camera", "fov=62", CameraOption) == "fov=62"
    with pytest.raises(ConfigError, match=r"^camera: .*fov=<degrees>"):
        convert("camera", value, CameraOption)


def test_the_camera_of_training_pictures_is_over_their_sides() -> None:
    fov = CameraChoice.of("fov=60").over_sides([(480, 640), (240, 320)], key="data.source.camera")
    across = 0.5 / math.tan(math.radians(30))
    assert fov == pytest.approx((across, across * 4 / 3))
    assert CameraChoice.of((500, 510, 320, 240)).over_sides([(480, 640)], key="x") == (500 / 640, 510 / 480)
    with pytest.raises(ConfigError, match=r"^data.source.camera: pictures of several shapes"):
        CameraChoice.of("fov=60").over_sides([(480, 640), (640, 480)], key="data.source.camera")
    with pytest.raises(ConfigError, match=r"^data.source.camera: 'auto' states no camera"):
        CameraChoice.of("auto").over_sides([(480, 640)], key="data.source.camera")
