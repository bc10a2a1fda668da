"""From traced surfaces to an RGB image: light, shadow, exposure, and the flaws of a real camera."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hudepth.base.camera.intrinsics import Intrinsics
from hudepth.data.rooms.look import Look
from hudepth.data.rooms.materials import Material, pattern_weight
from hudepth.data.rooms.raycast import BOX, CYLINDER, F32, F64, ROOM_FACES, Solids, View, trace

_SHADOW_REACH = 2.5
_SHADOW_CELLS = 224


class Light(NamedTuple):
    """A lamp at ``position`` [3] in metres; ``colour`` [3] is linear RGB, the irradiance at one metre."""

    position: F64
    colour: F64


class Scene(NamedTuple):
    """All that is needed to render a room of ``room_size`` [3] in metres from any place in it."""

    room_size: F64
    solids: Solids
    materials: list[Material]
    surface_material: NDArray[np.int16]
    """[6 + n] index into ``materials`` of each room face and solid."""
    ceiling_light: Light
    """The one that casts shadows."""
    fill_light: Light
    ambient: F64
    """[3] linear RGB."""
    shadow: F32
    """[cells, cells] metres below the ceiling light to the first surface, see :func:`shadow_map`."""
    look: Look


def shadow_map(room_size: F64, solids: Solids, light_position: F64) -> F32:
    """Trace rays down from a light; a point further below it than the value of its cell lies in shadow.

    Cells are equally spaced in slope (horizontal over vertical distance), within ``+-_SHADOW_REACH``.
    """
    slopes = np.linspace(-_SHADOW_REACH, _SHADOW_REACH, _SHADOW_CELLS, dtype=np.float32)
    axes = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return trace(View(light_position, axes, slopes, slopes), room_size, solids)[0]


class _Hits(NamedTuple):
    """Points [3, n] of h * w rays in world coordinates [m], with normals [3, n] and coordinates on their face."""

    point: F32
    normal: F32
    u: F32
    v: F32
    surface: NDArray[np.int16]


def _find_hits(scene: Scene, view: View, depth: F32, surface: NDArray[np.int16]) -> _Hits:
    """Find point, normal and face coordinates of every hit, in the solid's own frame and in the world."""
    axes = view.axes.astype(np.float32)
    flat, z = surface.ravel(), depth.ravel()
    rays = [np.add.outer(view.ys * axes[1, k], view.xs * axes[0, k] + axes[2, k]).ravel() for k in range(3)]
    point = np.stack([ray * z + np.float32(view.origin[k]) for k, ray in enumerate(rays)])

    solids = scene.solids
    room = np.repeat(scene.room_size[None] / 2, ROOM_FACES, 0)
    centre = np.concatenate([room, solids.centre]).astype(np.float32)
    half = np.concatenate([room, solids.half]).astype(np.float32)
    yaw = np.concatenate([np.zeros(ROOM_FACES), solids.yaw])
    cos, sin = np.cos(yaw).astype(np.float32)[flat], np.sin(yaw).astype(np.float32)[flat]
    dx, dy, dz = (point[k] - centre[flat, k] for k in range(3))
    local: F32 = np.stack([dx * cos - dz * sin, dy, dx * sin + dz * cos])
    unit: F32 = local / half.T[:, flat]

    axis = np.abs(unit).argmax(0)
    side = np.where(flat < ROOM_FACES, np.float32(-1), np.float32(1))
    normal = np.zeros_like(local)
    picked = np.take_along_axis(unit, axis[None], 0)[0]
    np.put_along_axis(normal, axis[None], (np.sign(picked) * side)[None], 0)
    kind = np.concatenate([np.full(ROOM_FACES, BOX), solids.kind])[flat]
    i = np.flatnonzero(kind != BOX)
    normal[:, i] = _round_normal(unit[:, i], half[flat[i]].T, tube=kind[i] == CYLINDER)
    u = np.where(axis == 0, local[2], local[0])
    v = np.where(axis == 1, local[2], local[1])
    world = np.stack([normal[0] * cos + normal[2] * sin, normal[1], normal[2] * cos - normal[0] * sin])
    return _Hits(point, world, u, v, flat)


def _round_normal(unit: F32, half: F32, *, tube: NDArray[np.bool_]) -> F32:
    """Return the normals [3, n] of ellipsoids, and of cylinders where ``tube``, in the solid's own frame."""
    normal: F32 = unit / half
    normal[1, tube] = 0
    cap = tube & (np.abs(unit[1]) > 0.9999)
    normal[:, cap] = np.sign(unit[1, cap]) * np.array([[0], [1], [0]], np.float32)
    normal /= np.linalg.norm(normal, axis=0) + np.float32(1e-9)
    return normal


def _albedo(scene: Scene, hits: _Hits, footprint: F32) -> tuple[F32, NDArray[np.bool_]]:
    """Return linear RGB [3, n] of every point, and which of them glow."""
    number = scene.surface_material[hits.surface]
    albedo = np.empty((3, number.size), np.float32)
    for k, material in enumerate(scene.materials):
        i = np.flatnonzero(number == k)
        if i.size:
            weight = pattern_weight(material, hits.u[i], hits.v[i], footprint[i])
            first, second = np.array([material.first, material.second], np.float32)[..., None]
            albedo[:, i] = first + weight * (second - first)
    return np.maximum(albedo, 0), np.array([m.pattern == "glow" for m in scene.materials])[number]


def _lit_fraction(scene: Scene, point: F32, upwards: F32) -> F32:
    """Return how much of the ceiling light reaches each point [n], from four cells of the shadow map."""
    light = scene.ceiling_light.position.astype(np.float32)
    drop = light[1] - point[1]
    per_slope = np.float32((_SHADOW_CELLS - 1) / (2 * _SHADOW_REACH))
    steep = per_slope / np.maximum(drop, 1e-3)
    a = (point[0] - light[0]) * steep + np.float32((_SHADOW_CELLS - 1) / 2)
    b = (point[2] - light[2]) * steep + np.float32((_SHADOW_CELLS - 1) / 2)
    inside = (a > 1) & (a < _SHADOW_CELLS - 2) & (b > 1) & (b < _SHADOW_CELLS - 2) & (drop > 0.05)
    i = np.flatnonzero(inside)
    a, b = a[i], b[i]
    # Within one cell a vertical face spans drop / slope times the cell's width: with less tolerance it shades itself.
    slope = np.hypot(a - (_SHADOW_CELLS - 1) / 2, b - (_SHADOW_CELLS - 1) / 2)
    limit = drop[i] * (1 - (1 - np.abs(upwards[i])) * 1.5 / np.maximum(slope, 1)) - np.float32(0.03)
    across, along = a % 1, b % 1
    cell = b.astype(np.int32) * _SHADOW_CELLS + a.astype(np.int32)
    flat = scene.shadow.ravel()
    near = (flat[cell] > limit) * (1 - across) + (flat[cell + 1] > limit) * across
    far = (flat[cell + _SHADOW_CELLS] > limit) * (1 - across) + (flat[cell + _SHADOW_CELLS + 1] > limit) * across
    lit = np.ones(point.shape[1], np.float32)
    lit[i] = near * (1 - along) + far * along
    return lit


def _irradiance(light: Light, hits: _Hits) -> F32:
    """Lambert's cosine times the falloff with distance, [n]; softened, since a real lamp has a size."""
    towards = light.position.astype(np.float32)[:, None] - hits.point
    squared = np.einsum("kn,kn->n", towards, towards)
    cosine = np.einsum("kn,kn->n", towards, hits.normal) / np.sqrt(squared)
    return np.asarray(np.maximum(cosine, 0) / (0.8 + squared))


def _corner_shade(scene: Scene, hits: _Hits) -> F32:
    """Darken towards the edges of the room, where less light arrives from around, [n]."""
    shade = np.ones(hits.point.shape[1], np.float32)
    for k in range(3):
        for gap in (hits.point[k], np.float32(scene.room_size[k]) - hits.point[k]):
            shade *= 1 - 0.03 / (np.maximum(gap, 0) + 0.12) * (1 - np.abs(hits.normal[k]))
    return shade


def render(scene: Scene, view: View, rng: np.random.Generator) -> tuple[NDArray[np.uint8], F32]:
    """Render image [h, w, 3] RGB and depth [h, w] along the optical axis [m].

    Exposure, white balance and sensor noise are drawn from ``rng``; the geometry does not depend on it.
    """
    depth, surface = trace(view, scene.room_size, scene.solids)
    hits = _find_hits(scene, view, depth, surface)
    height, width = depth.shape
    flat = depth.ravel()
    facing = np.abs(np.einsum("kn,kn->n", view.origin.astype(np.float32)[:, None] - hits.point, hits.normal))
    pixel = np.float32(1 / Intrinsics.of_nyu(height, width).fx)
    albedo, glow = _albedo(scene, hits, flat * flat * pixel / np.maximum(facing, 1e-2))

    sky = _corner_shade(scene, hits) * (0.82 + 0.12 * hits.normal[1] + 0.08 * hits.normal[0])
    ceiling = _irradiance(scene.ceiling_light, hits) * _lit_fraction(scene, hits.point, hits.normal[1])
    fill = _irradiance(scene.fill_light, hits)
    sources = ((scene.ambient, sky), (scene.ceiling_light.colour, ceiling), (scene.fill_light.colour, fill))
    light = np.zeros((3, flat.size), np.float32)
    for colour, amount in sources:
        light += colour.astype(np.float32)[:, None] * amount
    light[:, glow] = 1
    return _expose((albedo * light).reshape(3, height, width), view, rng, scene.look), depth


@cache
def _tone_curve() -> F32:
    """4096 steps of linear light in [0, 2) to 8-bit values, with a soft shoulder instead of a hard clip."""
    linear = np.arange(4096) / 2048
    return np.asarray(255 * np.sqrt((1 - np.exp(-1.9 * linear)) / (1 - np.exp(-3.8))), np.float32)


def _expose(linear: F32, view: View, rng: np.random.Generator, look: Look) -> NDArray[np.uint8]:
    """Turn linear light [3, h, w] into 8 bits [h, w, 3], with the blur of a lens and the noise of a sensor."""
    linear[:, 1:-1] = 0.5 * linear[:, 1:-1] + 0.25 * (linear[:, :-2] + linear[:, 2:])
    linear[:, :, 1:-1] = 0.5 * linear[:, :, 1:-1] + 0.25 * (linear[:, :, :-2] + linear[:, :, 2:])
    gain = 0.15 * rng.uniform(*look.exposure) / float(np.minimum(linear[1], 3.0).mean())
    balance = gain * np.array([rng.uniform(*look.red), 1, rng.uniform(*look.blue)])
    vignette = 1 - np.float32(rng.uniform(0.1, 0.35)) * np.minimum(np.add.outer(view.ys**2, view.xs**2), 2)
    linear *= vignette * balance.astype(np.float32)[:, None, None]
    step = np.minimum(linear * np.float32(2048), np.float32(4095)).astype(np.int16)
    image: F32 = _tone_curve()[step.transpose(1, 2, 0)]
    if look.blur:
        sigma = 0.01 + look.blur * image.shape[0] * rng.random()
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)
    image += rng.standard_normal(image.shape, dtype=np.float32) * np.float32(rng.uniform(*look.noise))
    return _store(np.clip(image, 0, 255).astype(np.uint8), rng, look)


def _store(image: NDArray[np.uint8], rng: np.random.Generator, look: Look) -> NDArray[np.uint8]:
    """Change an image as the software of a camera does: another tone curve, and compression."""
    if look.contrast != (1.0, 1.0):
        curve = 255 * np.linspace(0, 1, 256) ** rng.uniform(*look.contrast)
        image = curve.astype(np.uint8)[image]
    if look.jpeg_quality is not None:
        quality = int(rng.uniform(*look.jpeg_quality))
        encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8)
    return image
