"""Build room number ``scene`` of a seed: furniture, materials, light, and a camera that moves through it."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hudepth.data.rooms.fittings import CATEGORIES
from hudepth.data.rooms.furnishing import VARIETIES, FurnishedRoom, Habits
from hudepth.data.rooms.furniture import Rng
from hudepth.data.rooms.look import Look
from hudepth.data.rooms.materials import room_materials
from hudepth.data.rooms.raycast import F64, Solids, camera_axes, pinhole_view, trace
from hudepth.data.rooms.shading import Light, Scene, shadow_map

_WALL_CLEARANCE_M = 0.35


class CameraPath(NamedTuple):
    """A camera that sways around ``centre`` by ``sway`` [3] in metres: any frame follows from its number alone."""

    centre: F64
    sway: F64
    phase: F64
    """[6] radians, for x, y, z, yaw, pitch and roll."""
    yaw: float
    pitch: float

    def pose(self, frame: int) -> tuple[F64, F64]:
        """Return origin [3] in metres and axes [3, 3] of a frame."""
        rate = np.array([0.23, 0.31, 0.19, 0.21, 0.53, 0.71])  # radians per frame: neighbours see much the same
        wave = np.sin(rate * frame + self.phase)
        axes = camera_axes(yaw=self.yaw + 0.5 * wave[3], pitch=self.pitch + 0.05 * wave[4], roll=0.04 * wave[5])
        return self.centre + self.sway * wave[:3], axes


class Room(NamedTuple):
    """A furnished room and the camera in it."""

    scene: Scene
    path: CameraPath


@lru_cache(maxsize=64)
def build_room(seed: int, scene: int, variety: str = "usual") -> Room:
    """Build a room of a key of ``VARIETIES``; the same on every call, in every process."""
    category = CATEGORIES[scene % len(CATEGORIES)]
    # spawn_key: without it the stream would be frame 0's, since SeedSequence pads its entropy with zeros.
    rng = np.random.default_rng(np.random.SeedSequence([seed, scene], spawn_key=(0,)))
    room = FurnishedRoom(rng, category, VARIETIES[variety])
    materials = room_materials(rng, category)
    faces = ["wall", "wall", "floor", "ceiling", "accent_wall", "wall"]
    names = faces + [part.material for part, *_ in room.placed]
    number = np.array([list(materials).index(name) for name in names], np.int16)
    solids = room.solids()
    look = VARIETIES[variety].look
    main, fill, ambient = _lights(rng, room.size, look)
    shadow = shadow_map(room.size, solids, main.position)
    furnished = Scene(room.size, solids, list(materials.values()), number, main, fill, ambient, shadow, look)
    return Room(furnished, _choose_path(rng, room, solids, VARIETIES[variety]))


def _lights(rng: Rng, size: F64, look: Look) -> tuple[Light, Light, F64]:
    """Return the ceiling light, a window or lamp that casts no shadows, and the ambient light off the walls."""
    warmth = rng.uniform(0, 1)
    warm = np.array([1.0, 0.92 - 0.14 * warmth, 0.82 - 0.32 * warmth])
    day = np.array([0.85, 0.95, 1.0])
    main = Light(np.array([size[0] / 2, size[1] - 0.16, size[2] / 2]), warm * rng.uniform(4.0, 7.0))
    side = size * [rng.choice([0.08, 0.92]), 0.65, rng.uniform(0.15, 0.85)]
    fill = Light(side, day * rng.uniform(*look.fill))
    return main, fill, (0.7 * warm + 0.3 * day) * rng.uniform(*look.ambient)


def _choose_path(rng: Rng, room: FurnishedRoom, solids: Solids, habits: Habits) -> CameraPath:
    """Of a few places and directions, take the one that shows most furniture near the wanted distance."""
    size, distance_m = room.size, rng.uniform(*habits.distance_m)
    places = rng.uniform(0.05, 0.95, (160, 2)) * size[[0, 2]]
    gaps = room.clearance(places)
    roomy = np.flatnonzero(gaps > _WALL_CLEARANCE_M)
    large = solids.half.max(1) > 0.2
    outline = Solids(*(values[large] for values in solids))

    def score(path: CameraPath, frame: int) -> float:
        depth, surface = trace(pinhole_view(*path.pose(frame), height=12, width=16), size, outline)
        blocked = float((depth < habits.near_m).mean())
        return len(np.unique(surface)) / 15 - 6 * blocked - abs(float(np.median(depth)) - distance_m)

    candidates = []
    for i in roomy[:6] if roomy.size else [int(gaps.argmax())]:
        x, z = places[i]
        away = np.arctan2(size[0] / 2 - x, size[2] / 2 - z) + rng.normal(0, 0.4)
        sway = min(max(gaps[i] - 0.25, 0.0), 0.5) / np.sqrt(2)
        centre, phase = np.array([x, rng.uniform(*habits.height_m), z]), rng.uniform(0, 2 * np.pi, 6)
        pitch = float(rng.uniform(*habits.pitch))
        candidates.append(CameraPath(centre, np.array([sway, 0.08, sway]), phase, float(away), pitch))
    return max(candidates, key=lambda path: min(score(path, 0), score(path, 4)))
