"""Furnish a room at random and move a camera through it; everything follows from (seed, scene)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hudepth.data.rooms import fittings as fittings
from hudepth.data.rooms.fittings import CATEGORIES, FREE, WALL
from hudepth.data.rooms.furniture import Part, Piece, Rng
from hudepth.data.rooms.materials import room_materials
from hudepth.data.rooms.raycast import F64, Solids, camera_axes, pinhole_view, trace
from hudepth.data.rooms.shading import Light, Scene, shadow_map

_WALL_CLEARANCE_M = 0.35


class Habits(NamedTuple):
    """How rooms are furnished and looked at."""

    covered_floor: float
    """Share of the floor that furniture is put on, if it fits."""
    long_m: tuple[float, float]
    """Range of a room's longer side [m]; living rooms and offices reach 9 m in any case."""
    distance_m: tuple[float, float]
    """Range of the median depth that a camera looks for [m]."""
    near_m: float
    """What is nearer counts as in the way [m]."""
    height_m: tuple[float, float]
    """Range of the camera's height [m]."""
    pitch: tuple[float, float]
    """Range of the camera's pitch [radians]; negative looks down."""


VARIETIES = {
    "usual": Habits(0.38, (3.6, 6.0), (1.8, 3.6), 0.9, (1.1, 1.7), (-0.28, -0.08)),
    "wide": Habits(0.55, (3.0, 9.0), (1.0, 5.0), 0.5, (0.7, 1.9), (-0.6, 0.05)),
}
"""``usual`` rooms, seen as one would photograph them; and ``wide``: small, large and full ones, seen from near and far,
with a spread of depths like that of NYU Depth V2."""


class CameraPath(NamedTuple):
    """A camera that sways around one place and looks about: any frame follows from its number alone."""

    centre: F64
    """[3] metres."""
    sway: F64
    """[3] metres along x, y, z."""
    phase: F64
    """[6] radians, for x, y, z, yaw, pitch and roll."""
    yaw: float
    pitch: float

    def pose(self, frame: int) -> tuple[F64, F64]:
        """Return origin [3] in metres and axes [3, 3] of a frame."""
        rate = np.array([0.23, 0.31, 0.19, 0.21, 0.53, 0.71])  # radians a frame; neighbours see much the same
        wave = np.sin(rate * frame + self.phase)
        axes = camera_axes(yaw=self.yaw + 0.5 * wave[3], pitch=self.pitch + 0.05 * wave[4], roll=0.04 * wave[5])
        return self.centre + self.sway * wave[:3], axes


class Room(NamedTuple):
    """A furnished room and the camera in it."""

    scene: Scene
    path: CameraPath


class _Furnisher:
    """Collects the parts of a room and keeps the pieces apart."""

    def __init__(self, rng: Rng, category: str, habits: Habits) -> None:
        self.rng, self.habits = rng, habits
        shortest, longest = habits.long_m
        long = rng.uniform(shortest, 9.0 if category in ("living_room", "office") else longest)
        short = rng.uniform(min(3.0, long), min(5.0, np.sqrt(96 - long**2)))  # keeps every depth below 10 m
        x, z = (long, short) if rng.random() < 0.5 else (short, long)
        self.size = np.array([x, rng.uniform(2.4, 2.9), z])
        self.low, self.high = np.empty((0, 3)), np.empty((0, 3))
        self.placed: list[tuple[Part, float, float, float]] = []

    def put(self, piece: Piece, x: float, z: float, yaw: float, *, gap: float = 0.03) -> bool:
        """Place a piece with the middle of its back at x, z, if its space is free and in the room."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        middle = np.array([x + sin * piece.depth / 2, z + cos * piece.depth / 2])
        reach = np.abs([[cos, sin], [sin, cos]]) @ [piece.width / 2, piece.depth / 2]
        bottom, top = min(part.y[0] for part in piece.parts), max(part.y[1] for part in piece.parts)
        low = np.array([middle[0] - reach[0], bottom, middle[1] - reach[1]])
        high = np.array([middle[0] + reach[0], top, middle[1] + reach[1]])
        outside = (low < -1e-6).any() or (high > self.size + 1e-6).any()
        if outside or ((low - gap < self.high) & (high + gap > self.low)).all(1).any():
            return False
        self.low, self.high = np.vstack([self.low, low]), np.vstack([self.high, high])
        self.add(piece, x, z, yaw)
        return True

    def add(self, piece: Piece, x: float, z: float, yaw: float) -> None:
        """Place a piece that takes no space."""
        self.placed += [(part, x, z, yaw) for part in piece.parts]

    def at_wall(self, wall: int, along: float) -> tuple[float, float, float]:
        """Return x, z, yaw with the back to wall 0..3 (z = 0, z = end, x = 0, x = end); ``along`` in 0..1."""
        x, _, z = (float(extent) for extent in self.size)
        turn = np.pi / 2
        return [(along * x, 0, 0), (along * x, z, np.pi), (0, along * z, turn), (x, along * z, -turn)][wall]

    def put_at_wall(self, piece: Piece, *, tries: int = 12) -> bool:
        """Place a piece with its back to any wall."""
        return any(
            self.put(piece, *self.at_wall(int(self.rng.integers(4)), self.rng.uniform(0, 1))) for _ in range(tries)
        )

    def put_free(self, piece: Piece, *, tries: int = 12) -> bool:
        """Place a piece away from the walls, roughly parallel to them if it is large."""
        for _ in range(tries):
            turn = self.rng.normal(0, 0.12) if piece.width > 0.8 else self.rng.uniform(0, np.pi)
            x, z = self.rng.uniform(0.2, 0.8, 2) * self.size[[0, 2]]
            if self.put(piece, x, z, np.pi / 2 * self.rng.integers(4) + turn, gap=0.25):
                return True
        return False

    def covered(self) -> float:
        """Fraction of the floor that furniture stands on."""
        area = (self.high - self.low)[:, [0, 2]].prod(1)
        return float(area[self.low[:, 1] < 0.2].sum() / self.size[[0, 2]].prod())

    def clearance(self, places: F64) -> F64:
        """Distance [n] from places x, z [n, 2] to the nearest wall or piece [m], or less; negative inside one."""
        plan = [0, 2]
        walls = np.minimum(places, self.size[plan] - places).min(1)
        at = places[:, None]
        pieces = np.maximum(self.low[:, plan] - at, at - self.high[:, plan]).max(2).min(1, initial=np.inf)
        gaps: F64 = np.minimum(walls, pieces)
        return gaps

    def solids(self, names: list[str]) -> tuple[Solids, list[int]]:
        """Return all parts in world coordinates, and each one's material as an index into ``names``."""
        spans = np.array([[part.x, part.y, part.z] for part, *_ in self.placed], dtype=np.float64)
        x, z, yaw = np.array([place for _, *place in self.placed], dtype=np.float64).T
        middle, half = spans.mean(2), (spans[..., 1] - spans[..., 0]) / 2
        cos, sin = np.cos(yaw), np.sin(yaw)
        centre = np.stack(
            [
                x + middle[:, 0] * cos + middle[:, 2] * sin,
                middle[:, 1],
                z + middle[:, 2] * cos - middle[:, 0] * sin,
            ],
            1,
        )
        kind = np.array([part.kind for part, *_ in self.placed], np.int8)
        return Solids(kind, centre, half, yaw), [names.index(part.material) for part, *_ in self.placed]


def _furnish(room: _Furnisher, category: str) -> None:
    rng, size = room.rng, room.size
    room.put_at_wall(fittings.door(rng))
    for _ in range(int(rng.integers(1, 4))):
        room.put_at_wall(fittings.window(rng))
    room.put_free(FREE[category][0](rng))
    for make in WALL[category] + [WALL[category][i] for i in rng.permutation(len(WALL[category]))]:
        if room.covered() < room.habits.covered_floor:
            room.put_at_wall(make(rng))
    for _ in range(5):
        if room.covered() < room.habits.covered_floor:
            room.put_free(FREE[category][int(rng.integers(len(FREE[category])))](rng))
    for _ in range(int(rng.integers(2, 7))):
        room.put_at_wall(fittings.picture(rng))
    middle = size / 2
    if rng.random() < 0.6:
        w, d = rng.uniform(0.4, 0.64, 2) * size[[0, 2]]
        room.add(fittings.rug(w, d), middle[0], middle[2] - d / 2, 0.0)
    for wall in range(4):
        room.add(fittings.skirting(size[0 if wall < 2 else 2]), *room.at_wall(wall, 0.5))
    room.add(fittings.ceiling_lamp(size[1]), middle[0], middle[2] - 0.22, 0.0)


def _choose_path(room: _Furnisher, solids: Solids) -> CameraPath:
    """Of a few places and directions, take the one that shows most furniture near a distance usual in NYU."""
    rng, size, habits = room.rng, room.size, room.habits
    distance_m = rng.uniform(*habits.distance_m)
    best, path = -np.inf, None
    places = rng.uniform(0.05, 0.95, (160, 2)) * size[[0, 2]]
    gaps = room.clearance(places)
    roomy = np.flatnonzero(gaps > _WALL_CLEARANCE_M)
    large = solids.half.max(1) > 0.2
    outline = Solids(*(values[large] for values in solids))
    for i in roomy[:6] if roomy.size else [int(gaps.argmax())]:
        x, z = places[i]
        away = np.arctan2(size[0] / 2 - x, size[2] / 2 - z) + rng.normal(0, 0.4)
        sway = min(max(gaps[i] - 0.25, 0.0), 0.5) / np.sqrt(2)
        candidate = CameraPath(
            centre=np.array([x, rng.uniform(*habits.height_m), z]),
            sway=np.array([sway, 0.08, sway]),
            phase=rng.uniform(0, 2 * np.pi, 6),
            yaw=float(away),
            pitch=float(rng.uniform(*habits.pitch)),
        )
        poses = (candidate.pose(frame) for frame in (0, 4))
        score = min(_score(pose, size, outline, distance_m=distance_m, near_m=habits.near_m) for pose in poses)
        if score > best:
            best, path = score, candidate
    assert path is not None
    return path


def _score(pose: tuple[F64, F64], size: F64, solids: Solids, *, distance_m: float, near_m: float) -> float:
    depth, surface = trace(pinhole_view(*pose, height=12, width=16), size, solids)
    blocked = float((depth < near_m).mean())
    variety = len(np.unique(surface)) / 15
    return variety - 6 * blocked - abs(float(np.median(depth)) - distance_m)


def _lights(rng: Rng, size: F64) -> tuple[Light, Light, F64]:
    """Return the ceiling light, a window or lamp without shadows, and what the walls reflect."""
    warmth = rng.uniform(0, 1)
    warm = np.array([1.0, 0.92 - 0.14 * warmth, 0.82 - 0.32 * warmth])
    day = np.array([0.85, 0.95, 1.0])
    main = Light(np.array([size[0] / 2, size[1] - 0.16, size[2] / 2]), warm * rng.uniform(4.0, 7.0))
    side = size * [rng.choice([0.08, 0.92]), 0.65, rng.uniform(0.15, 0.85)]
    fill = Light(side, day * rng.uniform(0.4, 2.2))
    return main, fill, (0.7 * warm + 0.3 * day) * rng.uniform(0.35, 0.6)


@lru_cache(maxsize=4)
def build_room(seed: int, scene: int, variety: str = "usual") -> Room:
    """Furnish room number ``scene`` by the habits of a variety; the same on every call, in every process."""
    habits = VARIETIES[variety]
    category = CATEGORIES[scene % len(CATEGORIES)]
    # spawn_key: without it the stream would be frame 0's, since SeedSequence pads its entropy with zeros.
    rng = np.random.default_rng(np.random.SeedSequence([seed, scene], spawn_key=(0,)))
    room = _Furnisher(rng, category, habits)
    _furnish(room, category)
    materials = room_materials(rng, category)
    names = list(materials)
    solids, part_materials = room.solids(names)
    faces = [names.index(name) for name in ("wall", "wall", "floor", "ceiling", "accent_wall", "wall")]
    main, fill, ambient = _lights(rng, room.size)
    furnished = Scene(
        room_size=room.size,
        solids=solids,
        materials=list(materials.values()),
        surface_material=np.array(faces + part_materials, np.int16),
        ceiling_light=main,
        fill_light=fill,
        ambient=ambient,
        shadow=shadow_map(room.size, solids, main.position),
    )
    return Room(furnished, _choose_path(room, solids))
