from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.camera import Intrinsics
from hudepth.base.errors import ConfigError
from hudepth.viz.point_cloud import point_cloud


def read_ply(data: bytes) -> tuple[list[str], np.ndarray]:
    """A reader of its own: header lines, then the vertices by the header's properties."""
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    kinds = {"float": "<f4", "uchar": "u1"}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith("property")]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    vertices = np.frombuffer(body, fields)
    assert len(vertices) == count
    return lines, vertices


@given(st.integers(1, 6), st.integers(1, 6), st.integers(0, 99))
def test_points_project_back_to_their_pixels(height: int, width: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    depth = random.uniform(0.5, 9, (height, width)).astype(np.float32)
    image = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
    camera = Intrinsics(400.0, 410.0, 2.5, 1.5)
    cloud = point_cloud(depth, image, camera)
    x, y, z = cloud.points_m.T
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    np.testing.assert_allclose(x / z * camera.fx + camera.cx, columns.ravel(), atol=1e-3)
    np.testing.assert_allclose(y / z * camera.fy + camera.cy, rows.ravel(), atol=1e-3)
    np.testing.assert_array_equal(z, depth.ravel())
    _, vertices = read_ply(cloud.to_ply())
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(vertices[name], cloud.points_m[:, axis])
    for channel, name in enumerate(("red", "green", "blue")):
        np.testing.assert_array_equal(vertices[name], image.reshape(-1, 3)[:, channel])


def test_unmeasured_pixels_are_no_points_and_colour_is_optional() -> None:
    depth = np.array([[0, 2], [3, 0]], np.float32)
    cloud = point_cloud(depth, None, Intrinsics(1.0, 1.0, 0.0, 0.0))
    assert cloud.points_m.tolist() == [[2, 0, 2], [0, 3, 3]]
    lines, vertices = read_ply(cloud.to_ply())
    assert vertices.dtype.names == ("x", "y", "z")
    assert "comment x right, y down, z forward, in metres" in lines


def test_nyu_stands_in_for_a_camera_that_nobody_stated_and_the_file_says_so() -> None:
    lines, _ = read_ply(point_cloud(np.ones((240, 320), np.float32), None).to_ply())
    (line,) = (line for line in lines if line.startswith("comment camera"))
    assert "fx 259.429 fy 259.735" in line  # half of NYU's at half the size
    assert "NYU Depth V2's, assumed, scaled to 320 x 240: not this camera's own" in line
    whole = Intrinsics.of_nyu(480, 640)
    assert (whole.fx, whole.fy, whole.cx, whole.cy) == pytest.approx((518.857901, 519.469611, 325.582449, 253.736166))
    # the middle of the image stays the middle: a pixel's centre lies half a pixel from its edge
    half = Intrinsics.of_nyu(240, 320)
    assert (half.cx + 0.5) * 2 - 0.5 == pytest.approx(whole.cx)
    given = point_cloud(np.ones((2, 2), np.float32), None, Intrinsics(1.0, 1.0, 0.0, 0.0)).comment
    assert "as given" in given


@pytest.mark.parametrize("values", [(0.0, 1.0, 0.0, 0.0), (1.0, float("nan"), 0.0, 0.0), (1.0, 1.0, float("inf"), 0.0)])
def test_no_camera(values: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match=r"^camera: .* Pass camera="):
        Intrinsics(*values)
