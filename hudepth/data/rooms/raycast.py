"""A ray caster for rooms made of boxes, ellipsoids and cylinders, in plain numpy, with exact depth.

World axes: x and z along the floor, y up, the floor at y = 0 and the room in [0, size]. Camera axes: right,
down, forward. A ray is ``origin + t * (forward + x * right + y * down)``, so its ``t`` *is* the depth along
the optical axis (z-depth, NYU's convention), not the length of the ray.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hudepth.base.camera.intrinsics import Intrinsics

F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
Float: TypeAlias = NDArray[np.floating]

BOX, ELLIPSOID, CYLINDER = 0, 1, 2
ROOM_FACES = 6
"""The first surfaces are the room's faces: 2 * axis for the side at 0, 2 * axis + 1 for the other."""

_NEAR_M = 0.05
_NEVER_ZERO = 1e-20
"""Added to directions: a ray parallel to a face gets a huge distance to it instead of a division by zero."""


class View(NamedTuple):
    """Rays from ``origin`` [3] in metres, one for each pair of ``xs`` [w] and ``ys`` [h], ascending slopes."""

    origin: F64
    axes: F64
    """[3, 3], rows right, down, forward; orthonormal."""
    xs: F32
    ys: F32


class Solids(NamedTuple):
    """Unit shapes scaled by ``half`` [n, 3], turned by ``yaw`` and moved to ``centre`` [n, 3], in metres."""

    kind: NDArray[np.int8]
    """[n] BOX, ELLIPSOID or CYLINDER (upright)."""
    centre: F64
    half: F64
    yaw: F64
    """[n] radians about y; the solid's own z axis points to (sin yaw, 0, cos yaw)."""


def camera_axes(*, yaw: float, pitch: float, roll: float) -> F64:
    """Return [3, 3] rows right, down, forward; angles [rad]; forward is (sin yaw, 0, cos yaw) if level."""
    forward = np.array([np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)], dtype=np.float64)
    level = np.array([-np.cos(yaw), 0.0, np.sin(yaw)])
    below = np.cross(forward, level)
    right = np.cos(roll) * level + np.sin(roll) * below
    return np.stack([right, np.cross(forward, right), forward])


def pinhole_view(origin: F64, axes: F64, *, height: int, width: int, zoom: float = 1.0) -> View:
    """Return the rays through all pixel centres of NYU's camera at ``height`` x ``width``, its focal length zoomed."""
    camera = Intrinsics.of_nyu(height, width)
    xs = ((np.arange(width) - camera.cx) / (zoom * camera.fx)).astype(np.float32)
    ys = ((np.arange(height) - camera.cy) / (zoom * camera.fy)).astype(np.float32)
    return View(origin, axes, xs, ys)


def trace(view: View, room_size: F64, solids: Solids) -> tuple[F32, NDArray[np.int16]]:
    """Find the first surface each ray meets in a room of ``room_size`` [3] in metres.

    The rays start in the room and outside every solid. Returns depth [h, w] along the optical axis [m], and the
    surface [h, w]: a room face below ``ROOM_FACES``, else ``ROOM_FACES`` + the number of the solid.
    """
    depth, surface = _trace_room(view, room_size)
    starts, components = _local_rays(view, solids)
    for i, rows, columns in _screen_rectangles(view, solids):
        xs, ys, window = view.xs[columns], view.ys[rows], depth[rows, columns]
        near, far = _solid_interval(solids.kind[i], starts[i], components[i], xs, ys)
        hit = (near <= far) & (near > 0) & (near < window)
        np.copyto(window, near, where=hit, casting="same_kind")
        np.copyto(surface[rows, columns], np.int16(ROOM_FACES + i), where=hit)
    return depth, surface


def _trace_room(view: View, room_size: F64) -> tuple[F32, NDArray[np.int16]]:
    depth = np.full((len(view.ys), len(view.xs)), np.inf, np.float32)
    surface = np.zeros(depth.shape, np.int16)
    for axis in range(3):
        direction = _directions(view.axes[:, axis], view.xs, view.ys)
        outwards = direction > 0
        start = view.origin[axis]
        t = np.where(outwards, np.float32(room_size[axis] - start), np.float32(-start)) / direction
        nearer = t < depth
        np.copyto(depth, t, where=nearer)
        np.copyto(surface, 2 * axis + outwards.astype(np.int16), where=nearer)
    return depth, surface


def _directions(component: F64, xs: F32, ys: F32) -> F32:
    """Return [h, w] rays' component along an axis that has ``component`` along right, down and forward."""
    right, down, forward = component.astype(np.float32)
    direction: F32 = ys[:, None] * down + (xs * right + forward)
    direction += np.float32(_NEVER_ZERO)
    return direction


def _local_rays(view: View, solids: Solids) -> tuple[F64, F64]:
    """Return origin [n, 3], and right, down, forward (last) [n, 3, 3], in frames where solids have half extent 1."""
    cos, sin, zero = np.cos(solids.yaw), np.sin(solids.yaw), np.zeros(len(solids.yaw))
    turn = np.array([[cos, zero, -sin], [zero, zero + 1, zero], [sin, zero, cos]]).transpose(2, 0, 1)
    to_local = turn / solids.half[:, :, None]
    starts = np.einsum("nij,nj->ni", to_local, view.origin - solids.centre)
    return starts, to_local @ view.axes.T


def _screen_rectangles(view: View, solids: Solids) -> list[tuple[int, slice, slice]]:
    """List the solids in front of the camera, each with the rows and columns its corners span."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    local = solids.half[:, None] * signs
    cos, sin = np.cos(solids.yaw)[:, None], np.sin(solids.yaw)[:, None]
    x = local[..., 0] * cos + local[..., 2] * sin
    z = local[..., 2] * cos - local[..., 0] * sin
    corners = np.stack([x, local[..., 1], z], -1) + solids.centre[:, None] - view.origin
    camera = corners @ view.axes.T
    in_front = camera[..., 2] > _NEAR_M
    slopes = camera[..., :2] / np.maximum(camera[..., 2:], _NEAR_M)
    low, high = slopes.min(1), slopes.max(1)
    crossing = ~in_front.all(1)  # a corner behind the camera has no picture: test every ray
    low[crossing], high[crossing] = -np.inf, np.inf
    left, right = np.searchsorted(view.xs, low[:, 0]) - 1, np.searchsorted(view.xs, high[:, 0]) + 1
    top, bottom = np.searchsorted(view.ys, low[:, 1]) - 1, np.searchsorted(view.ys, high[:, 1]) + 1
    return [
        (int(i), slice(max(top[i], 0), bottom[i]), slice(max(left[i], 0), right[i]))
        for i in np.flatnonzero(in_front.any(1))
        if right[i] > 1 and bottom[i] > 1 and left[i] < len(view.xs) - 1 and top[i] < len(view.ys) - 1
    ]


def _solid_interval(kind: np.int8, start: F64, components: F64, xs: F32, ys: F32) -> tuple[Float, Float]:
    """Return [h, w] depths between which each ray is inside a solid; near > far where it misses."""
    if kind == BOX:
        near, far = _inside_slab(start[0], _directions(components[0], xs, ys))
        for axis in (1, 2):
            enter, leave = _inside_slab(start[axis], _directions(components[axis], xs, ys))
            np.maximum(near, enter, out=near)
            np.minimum(far, leave, out=far)
        return near, far
    # float64 for round solids: in float32 the discriminant of a thin lamp pole loses half its digits.
    x, y = xs.astype(np.float64), ys.astype(np.float64)[:, None]
    directions = [x * right + y * down + forward for right, down, forward in components]
    if kind == ELLIPSOID:
        return _inside_quadric(start, directions)
    near, far = _inside_quadric(start[[0, 2]], [directions[0], directions[2]])
    enter, leave = _inside_slab(start[1], directions[1] + _NEVER_ZERO)
    return np.maximum(near, enter), np.minimum(far, leave)


def _inside_slab(start: float, direction: Float) -> tuple[Float, Float]:
    """Return where rays enter and leave |coordinate| <= 1; overwrites ``direction``."""
    inverse = np.reciprocal(direction, out=direction)
    middle = inverse * direction.dtype.type(-start)
    reach = np.abs(inverse, out=inverse)
    return middle - reach, np.add(middle, reach, out=middle)


def _inside_quadric(start: F64, directions: list[Float]) -> tuple[Float, Float]:
    """Return where rays enter and leave the unit circle or sphere."""
    a = sum(d * d for d in directions) + _NEVER_ZERO**2
    b = sum(s * d for s, d in zip(start, directions, strict=True))
    root = b * b - a * (start @ start - 1)
    reach = np.sqrt(np.maximum(root, 0)) / a
    return np.where(root < 0, np.inf, -b / a - reach), -b / a + reach
