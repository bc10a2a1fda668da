from __future__ import annotations

import json
import struct
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.camera import Intrinsics
from hudepth.base.errors import ConfigError, DataError
from hudepth.viz.point_cloud import PointCloud, depth_edges, point_cloud


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


def read_glb(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A reader of its own, after the glTF 2.0 specification: the document, then the attributes of its points."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    binary = data[28 + size :]
    assert kind == b"BIN\0"
    assert binary_size == len(binary) == document["buffers"][0]["byteLength"]
    assert binary_size % 4 == 0
    (primitive,) = document["meshes"][document["nodes"][document["scenes"][0]["nodes"][0]]["mesh"]]["primitives"]
    assert primitive["mode"] == 0
    found = {}
    for name, number in primitive["attributes"].items():
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        found[name] = np.frombuffer(part, dtype).reshape(accessor["count"], int(accessor["type"][3:]))
    ends = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(found["POSITION"].min(axis=0), np.float32(ends["min"]))
    np.testing.assert_array_equal(found["POSITION"].max(axis=0), np.float32(ends["max"]))
    return document, found


@given(st.integers(1, 50), st.booleans(), st.integers(0, 99))
def test_a_glb_file_holds_the_points_with_y_up(count: int, coloured: bool, seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3)).astype(np.float32)
    colours = random.integers(256, size=(count, 3), dtype=np.uint8) if coloured else None
    document, found = read_glb(PointCloud(points, colours, "camera: x").to_glb())
    assert document["asset"]["version"] == "2.0"
    np.testing.assert_array_equal(found["POSITION"], points * [1, -1, -1])
    np.testing.assert_array_equal(found["COLOR_0"][:, :3], np.full((count, 3), 255) if colours is None else colours)
    assert (found["COLOR_0"][:, 3] == 255).all()


@given(st.integers(0, 300), st.integers(1, 300))
def test_thinning_keeps_that_many_of_the_points(count: int, points: int) -> None:
    numbers = np.arange(3 * count, dtype=np.float32).reshape(count, 3)
    cloud = PointCloud(numbers, np.tile((np.arange(count) % 256).astype(np.uint8)[:, None], (1, 3)))
    thin = cloud.thin(points)
    assert len(thin.points_m) == min(count, points)
    assert thin.colours is not None
    rows = (thin.points_m[:, 0] / 3).astype(int)
    assert len(set(rows)) == len(rows)
    assert (thin.colours[:, 0] == rows % 256).all()
    np.testing.assert_array_equal(thin.points_m, cloud.thin(points).points_m)


def test_points_between_two_surfaces_are_edges_and_those_on_a_surface_are_not() -> None:
    """A wall 2 m away before one at 4 m, joined by a ramp of five pixels as a network draws it."""
    camera = Intrinsics(520.0, 520.0, 319.5, 239.5)
    depth = np.full((480, 640), 4.0, np.float32)
    depth[:, 200:400] = 2.0
    ramp = cv2.blur(depth, (5, 1))
    edges = depth_edges(ramp, camera)
    between = (ramp > 2.01) & (ramp < 3.99)
    assert edges[between].all()
    near_edge = cv2.dilate(between.astype(np.uint8), np.ones((3, 3))) > 0
    assert not edges[~near_edge].any()
    flying = point_cloud(ramp, None, camera).points_m
    assert ((flying[:, 2] > 2.01) & (flying[:, 2] < 3.99)).sum() == between.sum() > 0
    kept = point_cloud(ramp, None, camera, edges=False).points_m
    assert not ((kept[:, 2] > 2.01) & (kept[:, 2] < 3.99)).any()


@pytest.mark.parametrize("scale", [0.25, 1.0, 3.0])
def test_a_floor_and_a_slanted_wall_are_no_edges_at_any_resolution(scale: float) -> None:
    height, width, focal = round(480 * scale), round(640 * scale), 520 * scale
    camera = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2)
    rows = (np.arange(height) - camera.cy)[:, None] / focal
    floor = np.broadcast_to(np.where(rows > 1.5 / 12, 1.5 / np.maximum(rows, 1e-6), 12.0), (height, width))
    assert not depth_edges(floor.astype(np.float32), camera)[rows[:, 0] > 1.6 / 12].any()
    across = (np.arange(width) - camera.cx)[None] / focal
    wall = np.broadcast_to(3 / (1 - 0.9 * across), (height, width)).astype(np.float32)
    assert not depth_edges(wall, camera).any()


def test_no_points_are_no_file() -> None:
    empty = PointCloud(np.zeros((0, 3), np.float32), None)
    for write in (empty.to_ply, empty.to_glb):
        with pytest.raises(DataError, match="no point is left"):
            write()
