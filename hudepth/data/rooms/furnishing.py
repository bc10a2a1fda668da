"""Furnish a room at random, piece by piece, without overlaps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hudepth.data.rooms.fittings import FREE, WALL, ceiling_lamp, door, picture, rug, skirting, window
from hudepth.data.rooms.furniture import Part, Piece, Rng, around
from hudepth.data.rooms.look import SNAPSHOT, STUDIO, Look
from hudepth.data.rooms.raycast import BOX, CYLINDER, ELLIPSOID, F64, Solids


class Habits(NamedTuple):
    """How rooms are furnished and viewed."""

    covered_floor: float
    """Share of the floor to cover with furniture, as far as it fits."""
    long_m: tuple[float, float]
    """Range of a room's longer side [m]; living rooms and offices reach 9 m in any case."""
    distance_m: tuple[float, float]
    """Range of the median depth that a camera looks for [m]."""
    near_m: float
    """Anything nearer blocks the view [m]."""
    height_m: tuple[float, float]
    """Range of the camera's height [m]."""
    pitch: tuple[float, float]
    """Range of the camera's pitch [rad]; negative looks down."""
    loose_things: int = 0
    """At most so many things lie on furniture, besides those that belong to it."""
    look: Look = STUDIO
    """Light and camera."""


VARIETIES = {
    "usual": Habits(0.38, (3.6, 6.0), (1.8, 3.6), 0.9, (1.1, 1.7), (-0.28, -0.08)),
    "wide": Habits(0.55, (3.0, 9.0), (1.0, 5.0), 0.5, (0.7, 1.9), (-0.6, 0.05)),
    "homes": Habits(0.65, (2.6, 9.0), (0.9, 5.0), 0.45, (0.6, 1.9), (-0.6, 0.15), loose_things=70, look=SNAPSHOT),
}
"""``usual``: rooms as one would photograph them. ``wide``: small, large and crowded rooms seen from near and far, with
depths spread as in NYU Depth V2. ``homes``: as ``wide``, and full of loose things, in mixed light, through the camera
of a phone: over- and underexposed, with wrong white balance, noise, blur and the blocks of JPEG."""

_LOOSE = (
    "accent0",
    "accent1",
    "accent2",
    "accent3",
    "dark",
    "white",
    "books",
    "pillow",
    "fabric",
    "cardboard",
    "metal",
)


class FurnishedRoom:
    """The parts of one room of ``size`` [3] in metres, in world coordinates, and the space each piece takes."""

    def __init__(self, rng: Rng, category: str, habits: Habits) -> None:
        self.rng = rng
        shortest, longest = habits.long_m
        long = rng.uniform(shortest, 9.0 if category in ("living_room", "office") else longest)
        short = rng.uniform(min(3.0, long), min(5.0, np.sqrt(96 - long**2)))  # keeps every depth below 10 m
        x, z = (long, short) if rng.random() < 0.5 else (short, long)
        self.size = np.array([x, rng.uniform(2.4, 2.9), z])
        self.low, self.high = np.empty((0, 3)), np.empty((0, 3))
        self.placed: list[tuple[Part, float, float, float]] = []
        self._furnish(category, habits.covered_floor)
        if habits.loose_things:
            self._scatter(habits.loose_things)

    def _furnish(self, category: str, covered_floor: float) -> None:
        rng, free, wall = self.rng, FREE[category], WALL[category]
        self._put_at_wall(door(rng))
        for _ in range(int(rng.integers(1, 4))):
            self._put_at_wall(window(rng))
        self._put_free(free[0](rng))
        for make in wall + [wall[i] for i in rng.permutation(len(wall))]:
            if self._covered() < covered_floor:
                self._put_at_wall(make(rng))
        for _ in range(5):
            if self._covered() < covered_floor:
                self._put_free(free[int(rng.integers(len(free)))](rng))
        for _ in range(int(rng.integers(2, 7))):
            self._put_at_wall(picture(rng))
        x, height, z = self.size
        if rng.random() < 0.6:
            w, d = rng.uniform(0.4, 0.64, 2) * [x, z]
            self._add(rug(w, d), x / 2, z / 2 - d / 2, 0.0)
        for side in range(4):
            self._add(skirting(x if side < 2 else z), *self._at_wall(side, 0.5))
        self._add(ceiling_lamp(height), x / 2, z / 2 - 0.22, 0.0)

    def _scatter(self, most: int) -> None:
        """Hang up more pictures, and put loose things on flat parts at the height of knees to shoulders."""
        rng = self.rng
        for _ in range(int(rng.integers(8))):
            self._put_at_wall(picture(rng))
        flat = [
            placed
            for placed in self.placed
            if (part := placed[0]).kind == BOX and 0.25 < part.y[1] < 1.4 and min(np.ptp(part.x), np.ptp(part.z)) > 0.2
        ]
        for _ in range(int(rng.integers(most)) if flat else 0):
            part, x0, z0, yaw = flat[int(rng.integers(len(flat)))]
            (x, z), y = (rng.uniform(*span) for span in (part.x, part.z)), part.y[1]
            width, height, depth = np.exp(rng.uniform(np.log(0.03), np.log([0.18, 0.3, 0.18])))
            kind = int(rng.choice([BOX, BOX, CYLINDER, ELLIPSOID]))
            spans = around(x, width), (y - 0.01, y + height), around(z, width if kind == CYLINDER else depth)
            self.placed.append((Part(str(rng.choice(_LOOSE)), *spans, kind), x0, z0, yaw))

    def _put(self, piece: Piece, x: float, z: float, yaw: float, *, gap: float = 0.03) -> bool:
        """Place a piece with the middle of its back at x, z, if its space is free and inside the room."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        middle = np.array([x + sin * piece.depth / 2, z + cos * piece.depth / 2])
        reach = np.abs([[cos, sin], [sin, cos]]) @ [piece.width / 2, piece.depth / 2]
        bottom, top = min(part.y[0] for part in piece.parts), max(part.y[1] for part in piece.parts)
        low, high = np.insert(middle - reach, 1, bottom), np.insert(middle + reach, 1, top)
        outside = (low < -1e-6).any() or (high > self.size + 1e-6).any()
        if outside or ((low - gap < self.high) & (high + gap > self.low)).all(1).any():
            return False
        self.low, self.high = np.vstack([self.low, low]), np.vstack([self.high, high])
        self._add(piece, x, z, yaw)
        return True

    def _add(self, piece: Piece, x: float, z: float, yaw: float) -> None:
        """Place a piece that blocks no other."""
        self.placed += [(part, x, z, yaw) for part in piece.parts]

    def _at_wall(self, wall: int, along: float) -> tuple[float, float, float]:
        """Return x, z, yaw with the back to wall 0..3 (z = 0, z = end, x = 0, x = end); ``along`` in 0..1."""
        x, _, z = (float(extent) for extent in self.size)
        return [(along * x, 0, 0), (along * x, z, np.pi), (0, along * z, np.pi / 2), (x, along * z, -np.pi / 2)][wall]

    def _put_at_wall(self, piece: Piece) -> None:
        """Place a piece with its back to any wall, if one of 12 tries fits."""
        rng = self.rng
        any(self._put(piece, *self._at_wall(int(rng.integers(4)), rng.uniform(0, 1))) for _ in range(12))

    def _put_free(self, piece: Piece) -> None:
        """Place a piece away from the walls, roughly parallel to them if it is large."""
        for _ in range(12):
            turn = self.rng.normal(0, 0.12) if piece.width > 0.8 else self.rng.uniform(0, np.pi)
            x, z = self.rng.uniform(0.2, 0.8, 2) * self.size[[0, 2]]
            if self._put(piece, x, z, np.pi / 2 * self.rng.integers(4) + turn, gap=0.25):
                return

    def _covered(self) -> float:
        """Return the share of the floor that furniture stands on."""
        area = (self.high - self.low)[:, [0, 2]].prod(1)
        return float(area[self.low[:, 1] < 0.2].sum() / self.size[[0, 2]].prod())

    def clearance(self, places: F64) -> F64:
        """Return a lower bound [n] of the distance from x, z [n, 2] to walls and pieces [m], negative inside one."""
        plan = [0, 2]
        walls = np.minimum(places, self.size[plan] - places).min(1)
        at = places[:, None]
        pieces = np.maximum(self.low[:, plan] - at, at - self.high[:, plan]).max(2).min(1, initial=np.inf)
        return np.asarray(np.minimum(walls, pieces))

    def solids(self) -> Solids:
        """Return all parts in world coordinates."""
        spans = np.array([[part.x, part.y, part.z] for part, *_ in self.placed], dtype=np.float64)
        x, z, yaw = np.array([place for _, *place in self.placed], dtype=np.float64).T
        (mx, my, mz), half = spans.mean(2).T, (spans[..., 1] - spans[..., 0]) / 2
        cos, sin = np.cos(yaw), np.sin(yaw)
        centre = np.stack([x + mx * cos + mz * sin, my, z + mz * cos - mx * sin], 1)
        return Solids(np.array([part.kind for part, *_ in self.placed], np.int8), centre, half, yaw)
