from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hudepth.data.rooms.raycast import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    ROOM_FACES,
    Solids,
    View,
    camera_axes,
    pinhole_view,
    trace,
)

ROOM = np.array([4.0, 2.5, 6.0])
angles = st.floats(-math.pi, math.pi)


def random_solids(rng: np.random.Generator, n: int) -> Solids:
    """Solids in the far part of ROOM, where no camera of these tests stands."""
    return Solids(
        kind=rng.integers(0, 3, n).astype(np.int8),
        centre=rng.uniform([0.5, 0.3, 2.5], [3.5, 2.2, 5.5], (n, 3)),
        half=rng.uniform(0.05, 0.6, (n, 3)),
        yaw=rng.uniform(-3, 3, n),
    )


def take(solids: Solids, i: NDArray[np.intp]) -> Solids:
    return Solids(solids.kind[i], solids.centre[i], solids.half[i], solids.yaw[i])


def random_view(rng: np.random.Generator, *, height: int = 24, width: int = 32) -> View:
    axes = camera_axes(yaw=rng.normal(0, 0.3), pitch=rng.normal(-0.1, 0.1), roll=rng.normal(0, 0.1))
    return pinhole_view(rng.uniform([0.5, 1.0, 0.2], [3.5, 1.8, 1.2]), axes, height=height, width=width)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_camera_axes_are_orthonormal_and_right_handed(yaw: float, pitch: float, roll: float) -> None:
    axes = camera_axes(yaw=yaw, pitch=pitch, roll=roll)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-12)


def test_level_camera_has_down_below_and_forward_by_its_yaw() -> None:
    _, down, forward = camera_axes(yaw=0.3, pitch=0.0, roll=0.0)
    np.testing.assert_allclose(down, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(forward, [math.sin(0.3), 0, math.cos(0.3)], atol=1e-12)


def test_depth_is_along_the_axis_not_along_the_ray() -> None:
    view = pinhole_view(np.array([2.0, 1.2, 1.0]), camera_axes(yaw=0, pitch=0, roll=0), height=48, width=64)
    depth, surface = trace(view, np.array([400.0, 250.0, 6.0]), random_solids(np.random.default_rng(0), 0))
    np.testing.assert_allclose(depth[surface == 5], 5.0, rtol=1e-6)  # one wall, one depth, out to the corners
    assert (surface == 5).any()


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_points_lie_on_the_surface_that_was_hit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    solids, view = random_solids(rng, 12), random_view(rng)
    depth, surface = trace(view, ROOM, solids)
    xs, ys = np.meshgrid(view.xs.astype(float), view.ys.astype(float))
    points = view.origin + depth[..., None] * (np.stack([xs, ys, np.ones_like(xs)], -1) @ view.axes)
    for face in range(ROOM_FACES):
        on_face = points[surface == face][:, face // 2]
        np.testing.assert_allclose(on_face, ROOM[face // 2] * (face % 2), atol=1e-5)
    for i in range(12):
        x, y, z = (points[surface == ROOM_FACES + i] - solids.centre[i]).T
        cos, sin = math.cos(solids.yaw[i]), math.sin(solids.yaw[i])
        a, b, c = np.stack([x * cos - z * sin, y, x * sin + z * cos]) / solids.half[i][:, None]
        size = {
            BOX: np.max(np.abs([a, b, c]), 0),
            ELLIPSOID: np.sqrt(a**2 + b**2 + c**2),
            CYLINDER: np.maximum(np.hypot(a, c), np.abs(b)),
        }[int(solids.kind[i])]
        np.testing.assert_allclose(size, 1, atol=1e-4)


@given(st.integers(0, 10_000), st.floats(0.3, 3.0))
@settings(max_examples=20, deadline=None)
def test_depth_scales_with_the_world(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    solids, view = random_solids(rng, 8), random_view(rng)
    depth, surface = trace(view, ROOM, solids)
    larger = solids._replace(centre=solids.centre * scale, half=solids.half * scale)
    scaled, scaled_surface = trace(view._replace(origin=view.origin * scale), ROOM * scale, larger)
    same = surface == scaled_surface  # rounding may move a silhouette by a ray
    assert same.mean() > 0.99
    np.testing.assert_allclose(scaled[same], depth[same] * scale, rtol=1e-4)


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_solids_only_come_nearer_and_their_order_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    solids, view = random_solids(rng, 8), random_view(rng)
    none, reverse = np.arange(0), np.arange(8)[::-1]
    empty, _ = trace(view, ROOM, take(solids, none))
    depth, _ = trace(view, ROOM, solids)
    backwards, _ = trace(view, ROOM, take(solids, reverse))
    assert (depth <= empty).all()
    np.testing.assert_array_equal(depth, backwards)


@pytest.mark.filterwarnings("error")
def test_rays_parallel_to_faces_divide_by_nothing() -> None:
    slopes = np.linspace(-1, 1, 5, dtype=np.float32)  # holds an exact 0
    solids = Solids(
        kind=np.array([BOX, CYLINDER, ELLIPSOID], np.int8),
        centre=np.array([[2.0, 1.0, 3.0], [2.0, 1.0, 4.0], [2.0, 1.0, 5.0]]),
        half=np.full((3, 3), 0.2),
        yaw=np.zeros(3),
    )
    ahead, _ = trace(View(np.array([2.0, 1.0, 1.0]), np.eye(3), slopes, slopes), ROOM, solids)
    assert ahead[2, 2] == pytest.approx(1.8)
    down = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    below, _ = trace(View(np.array([2.0, 2.0, 4.0]), down, slopes, slopes), ROOM, solids)
    assert below[2, 2] == pytest.approx(0.8)


def test_a_solid_that_reaches_behind_the_camera_is_seen() -> None:
    view = pinhole_view(np.array([2.0, 1.2, 1.0]), camera_axes(yaw=0, pitch=0, roll=0), height=48, width=64)
    bench = Solids(
        kind=np.array([BOX], np.int8),
        centre=np.array([[2.0, 0.2, 3.0]]),
        half=np.array([[1.5, 0.2, 2.9]]),
        yaw=np.zeros(1),
    )
    depth, surface = trace(view, ROOM, bench)
    _, ys = np.meshgrid(view.xs, view.ys)
    top = surface == ROOM_FACES
    assert top[-1].all()
    np.testing.assert_allclose(depth[top], 0.8 / ys[top], rtol=1e-5)  # its top lies 0.8 m below the camera
