"""Lamps, plants, what is fixed to the walls, and which pieces belong in which room."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from hudepth.data.rooms import furniture
from hudepth.data.rooms.cabinets import cabinet, counter, fridge, nightstand, shelf, television, wardrobe
from hudepth.data.rooms.furniture import Part, Piece, Rng, around, carton, chair, desk, dining_set, sofa
from hudepth.data.rooms.raycast import CYLINDER, ELLIPSOID


def floor_lamp(rng: Rng) -> Piece:
    """A standing lamp."""
    h = rng.uniform(1.4, 1.7)
    parts = [
        Part("dark", around(0, 0.14), (0, 0.03), (0, 0.28), CYLINDER),
        Part("metal", around(0, 0.015), (0.03, h - 0.1), (0.125, 0.155), CYLINDER),
        Part("shade", around(0, 0.19), (h - 0.28, h), (-0.05, 0.33), CYLINDER),
    ]
    return Piece(0.38, 0.33, parts)


def plant(rng: Rng) -> Piece:
    """A leafy plant in a pot."""
    parts = [
        Part("accent2", around(0, 0.15), (0, 0.3), (0.08, 0.38), CYLINDER),
        Part("dark", around(0, 0.02), (0.3, 0.6), (0.21, 0.25), CYLINDER),
    ]
    for _ in range(9):
        x, z, y = rng.normal(0, 0.1), 0.23 + rng.normal(0, 0.08), rng.uniform(0.45, 1.1)
        r, flat = rng.uniform(0.08, 0.17), rng.uniform(0.4, 1.0)
        parts.append(Part("leaf", around(x, r), around(y, r * flat), around(z, r), ELLIPSOID))
    return Piece(0.5, 0.5, parts)


def door(rng: Rng) -> Piece:
    """A door in its frame, with the floor in front of it kept free."""
    w = rng.uniform(0.8, 0.95)
    parts = [
        Part("trim", around(0, w / 2 + 0.07), (0, 2.1), (0, 0.02)),
        Part(str(rng.choice(["panel", "white"])), around(0, w / 2), (0.005, 2.03), (0.02, 0.035)),
        Part("metal", (w / 2 - 0.14, w / 2 - 0.04), (1.0, 1.03), (0.035, 0.09)),
    ]
    return Piece(w + 0.14, 0.7, parts)


def window(rng: Rng) -> Piece:
    """A bright window with a cross bar and curtains."""
    w, low, high = rng.uniform(0.9, 1.8), rng.uniform(0.85, 1.1), rng.uniform(1.9, 2.2)
    middle = (low + high) / 2
    parts = [
        Part("trim", around(0, w / 2 + 0.06), (low - 0.06, high + 0.06), (0, 0.02)),
        Part("trim", around(0, w / 2 + 0.1), (low - 0.1, low - 0.06), (0, 0.12)),
        Part("sky", around(0, w / 2), (low, high), (0.02, 0.022)),
        Part("trim", around(0, 0.025), (low, high), (0.02, 0.04)),
        Part("trim", around(0, w / 2), (middle, middle + 0.04), (0.02, 0.04)),
    ]
    if rng.random() < 0.6:
        inner, outer = w / 2 - 0.08, w / 2 + 0.22
        y, z = (low - 0.14, high + 0.15), (0.05, 0.12)
        parts += [Part("curtain", x, y, z) for x in ((-outer, -inner), (inner, outer))]
    return Piece(w + 0.5, 0.13, parts)


def picture(rng: Rng) -> Piece:
    """A framed picture."""
    w, h, y = rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.7), rng.uniform(1.45, 1.65)
    frame, motif = str(rng.choice(["wood", "dark", "white"])), str(rng.choice(["painting", "poster"]))
    border = Part(frame, around(0, w / 2), around(y, h / 2), (0, 0.025))
    inside = Part(motif, around(0, w / 2 - 0.04), (y - h / 2 + 0.04, y + h / 2 - 0.04), (0.025, 0.027))
    return Piece(w, 0.03, [border, inside])


def ceiling_lamp(height_m: float) -> Piece:
    """A round lamp under a ceiling at ``height_m``."""
    return Piece(0.44, 0.44, [Part("lamp", around(0, 0.22), (height_m - 0.1, height_m), (0, 0.44), CYLINDER)])


def rug(width_m: float, depth_m: float) -> Piece:
    """A rug."""
    return Piece(width_m, depth_m, [Part("rug", around(0, width_m / 2), (0, 0.012), (0, depth_m))])


def skirting(length_m: float) -> Piece:
    """A board along the foot of a wall."""
    return Piece(length_m, 0.012, [Part("trim", around(0, length_m / 2), (0, 0.08), (0, 0.012))])


Maker: TypeAlias = Callable[[Rng], Piece]
WALL: dict[str, list[Maker]] = {
    "bedroom": [furniture.bed, nightstand, wardrobe, desk, cabinet, shelf, plant, floor_lamp, television],
    "kitchen": [counter, fridge, counter, cabinet, shelf, carton, plant],
    "office": [desk, shelf, desk, cabinet, shelf, plant, wardrobe, floor_lamp],
    "living_room": [sofa, television, shelf, cabinet, floor_lamp, plant, sofa, desk],
}
"""Pieces that stand with their back to a wall, the most typical first."""
FREE: dict[str, list[Maker]] = {
    "bedroom": [carton, chair],
    "kitchen": [dining_set, chair],
    "office": [furniture.table, furniture.office_chair, carton],
    "living_room": [furniture.coffee_table, dining_set, chair, carton],
}
"""Pieces that stand in the middle of the room."""
CATEGORIES = tuple(WALL)
