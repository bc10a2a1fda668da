"""Tables, seats and beds. A piece is a list of simple solids with its back at z = 0 and its front towards +z."""

from __future__ import annotations

from itertools import pairwise, product
from typing import NamedTuple, TypeAlias

import numpy as np

from hudepth.data.rooms.raycast import BOX, CYLINDER, ELLIPSOID

Rng: TypeAlias = np.random.Generator
Span: TypeAlias = tuple[float, float]

ACCENTS = ("accent0", "accent1", "accent2", "accent3", "dark", "white")


class Part(NamedTuple):
    """One solid that fills the block x, y, z [m] of its piece; x = 0 is the middle, y = 0 the floor."""

    material: str
    x: Span
    y: Span
    z: Span
    kind: int = BOX


class Piece(NamedTuple):
    """A piece of furniture and the floor it needs: ``width`` along x, ``depth`` along z [m]."""

    width: float
    depth: float
    parts: list[Part]


def around(middle: float, half: float) -> Span:
    """Return the span of length ``2 * half`` centred at ``middle``."""
    return middle - half, middle + half


def clutter(rng: Rng, x: Span, z: Span, y: float, *, most: int = 4) -> list[Part]:
    """Put at most ``most`` boxes, cups and piles of books on a board at height ``y`` [m]."""
    parts = []
    for left, right in pairwise(np.linspace(x[0], x[1], most + 1)):
        if rng.random() < 0.4:
            continue
        half = min(rng.uniform(0.04, 0.14), (right - left) / 2.2)
        back = rng.uniform(z[0], max(z[0], z[1] - 2 * half))
        kind = CYLINDER if rng.random() < 0.4 else BOX
        height = rng.uniform(0.1, 0.28) if kind == CYLINDER else rng.uniform(0.03, 0.14)
        half = min(half, 0.05) if kind == CYLINDER else half
        material = str(rng.choice(ACCENTS))
        parts.append(Part(material, around((left + right) / 2, half), (y, y + height), (back, back + 2 * half), kind))
    return parts


def _legs(width: float, z: Span, top: float, thick: float) -> list[Part]:
    x = width / 2
    sides, ends = ((-x, -x + thick), (x - thick, x)), ((z[0], z[0] + thick), (z[1] - thick, z[1]))
    return [Part("wood", side, (0, top), end) for side, end in product(sides, ends)]


def table(rng: Rng, *, height: float = 0.74, width: Span = (1.1, 1.8), depth: Span = (0.75, 0.95)) -> Piece:
    """A table with four legs and things on it."""
    w, d, thick = rng.uniform(*width), rng.uniform(*depth), rng.uniform(0.04, 0.08)
    board = Part("wood", around(0, w / 2), (height - 0.04, height), (0, d))
    legs = _legs(w - 0.06, (0.03, d - 0.03), height - 0.04, thick)
    return Piece(w, d, [board, *legs, *clutter(rng, around(0, w / 2 - 0.1), (0.08, d - 0.1), height)])


def coffee_table(rng: Rng) -> Piece:
    """A low table with a shelf under its top."""
    w, d, parts = table(rng, height=rng.uniform(0.38, 0.46), width=(0.8, 1.2), depth=(0.5, 0.65))
    return Piece(w, d, [*parts, Part("wood", around(0, w / 2 - 0.08), (0.12, 0.14), (0.08, d - 0.08))])


def chair(rng: Rng) -> Piece:
    """A chair with a slatted back, facing +z."""
    w, d, seat = rng.uniform(0.4, 0.47), 0.44, rng.uniform(0.43, 0.48)
    parts = [Part(str(rng.choice(["wood", "accent0"])), around(0, w / 2), (seat - 0.04, seat), (0, d))]
    parts += _legs(w - 0.02, (0.01, d - 0.01), seat - 0.04, 0.035)
    slats = (-w / 2 + 0.01, -0.02, w / 2 - 0.05)
    parts += [Part("wood", (x, x + 0.04), (seat, 0.86), (0.005, 0.03)) for x in slats]
    return Piece(w, d, [*parts, Part("wood", around(0, w / 2), (0.8, 0.92), (0, 0.035))])


def office_chair(rng: Rng) -> Piece:
    """A swivel chair on a column and a round foot."""
    parts = [
        Part("dark", around(0, 0.28), (0.03, 0.07), (0, 0.56), CYLINDER),
        Part("metal", around(0, 0.03), (0.07, 0.44), (0.25, 0.31), CYLINDER),
        Part("fabric", around(0, 0.24), (0.44, 0.52), (0.05, 0.53)),
        Part("fabric", around(0, 0.22), (0.6, rng.uniform(0.95, 1.1)), (0.03, 0.1)),
        Part("dark", around(0, 0.03), (0.48, 0.65), (0.0, 0.03)),
    ]
    return Piece(0.56, 0.56, parts)


def sofa(rng: Rng) -> Piece:
    """A sofa with arms, seat and back cushions, and a pillow."""
    w, d, arm = rng.uniform(1.5, 2.3), rng.uniform(0.85, 0.95), rng.uniform(0.14, 0.22)
    parts = [
        Part("fabric", around(0, w / 2), (0.06, 0.28), (0, d - 0.03)),
        Part("fabric", around(0, w / 2), (0.28, 0.78), (0, 0.2)),
        Part("fabric", (-w / 2, -w / 2 + arm), (0.28, 0.6), (0.2, d)),
        Part("fabric", (w / 2 - arm, w / 2), (0.28, 0.6), (0.2, d)),
    ]
    for left, right in pairwise(np.linspace(-w / 2 + arm, w / 2 - arm, 3 if w < 1.9 else 4)):
        parts.append(Part("fabric", (left + 0.01, right - 0.01), (0.28, 0.43), (0.2, d)))
        parts.append(Part("fabric", (left + 0.02, right - 0.02), (0.43, 0.84), (0.2, 0.34)))
    side = rng.choice([-1, 1]) * (w / 2 - arm - 0.22)
    return Piece(w, d, [*parts, Part("accent1", around(side, 0.2), (0.42, 0.76), (0.32, 0.5), ELLIPSOID)])


def bed(rng: Rng) -> Piece:
    """A bed with a headboard at the wall, a blanket and pillows."""
    w, d, top = rng.uniform(1.0, 1.8), rng.uniform(1.95, 2.1), rng.uniform(0.45, 0.6)
    parts = [
        Part("wood", around(0, w / 2), (0.08, 0.28), (0, d)),
        Part("wood", around(0, w / 2), (0, rng.uniform(0.85, 1.15)), (0, 0.06)),
        Part("white", around(0, w / 2 - 0.02), (0.28, top), (0.06, d - 0.02)),
        Part("fabric", around(0, w / 2 + 0.01), (0.24, top + 0.04), (d * 0.38, d + 0.01)),
        Part("accent1", around(0, w / 2 + 0.015), (0.26, top + 0.06), (d * 0.36, d * 0.52)),
    ]
    middles = [0.0] if w < 1.3 else [-w / 4, w / 4]
    parts += [Part("pillow", around(x, 0.33), (top - 0.06, top + 0.16), (0.1, 0.52), ELLIPSOID) for x in middles]
    return Piece(w, d, parts)


def desk(rng: Rng) -> Piece:
    """A desk with a drawer unit, a monitor, a keyboard and a chair in front of it."""
    w, d, side = rng.uniform(1.2, 1.6), rng.uniform(0.65, 0.8), rng.choice([-1, 1])
    x = side * (w / 2 - 0.24)
    parts = [
        Part("wood", around(0, w / 2), (0.71, 0.74), (0, d)),
        Part("wood", around(x, 0.2), (0.02, 0.71), (0.05, d - 0.06)),
        *(Part("panel", around(x, 0.19), (low, low + 0.2), (d - 0.06, d - 0.04)) for low in (0.06, 0.27, 0.48)),
        Part("dark", around(0, 0.28), (0.86, 1.2), (0.2, 0.23)),
        Part("screen", around(0, 0.26), (0.88, 1.18), (0.23, 0.235)),
        Part("dark", around(0, 0.03), (0.74, 0.9), (0.17, 0.2)),
        Part("dark", around(0, 0.12), (0.74, 0.755), (0.1, 0.28)),
        Part("dark", around(0, 0.22), (0.74, 0.76), (d - 0.28, d - 0.14)),
        *(Part("metal", around(-x, 0.02), (0, 0.71), z) for z in ((0.05, 0.09), (d - 0.1, d - 0.06))),
    ]
    parts += clutter(rng, (0.32, w / 2), (0.1, d - 0.1), 0.74, most=2)
    return Piece(w, d + 0.45, parts + [_mirror(part, d + 0.42) for part in office_chair(rng).parts])


def dining_set(rng: Rng) -> Piece:
    """A table with chairs along both long sides."""
    reach = 0.3
    w, d, board = table(rng)
    parts = [part._replace(z=(part.z[0] + reach, part.z[1] + reach)) for part in board]
    model = chair(rng).parts
    for x, facing in product((-w / 4, w / 4), (1, -1)):
        gap = rng.uniform(-0.05, 0.12)
        for part in model:
            placed = part._replace(x=(part.x[0] + x, part.x[1] + x), z=(part.z[0] - gap, part.z[1] - gap))
            parts.append(placed if facing > 0 else _mirror(placed, 2 * reach + d))
    return Piece(w, d + 2 * reach, parts)


def _mirror(part: Part, depth: float) -> Part:
    """Turn a part to face the other way within ``depth``."""
    return part._replace(z=(depth - part.z[1], depth - part.z[0]))


def carton(rng: Rng) -> Piece:
    """A box, a stool or a bin on the floor."""
    half, h = rng.uniform(0.15, 0.28), rng.uniform(0.25, 0.5)
    kind = CYLINDER if rng.random() < 0.4 else BOX
    material = str(rng.choice(["cardboard", *ACCENTS]))
    return Piece(2 * half, 2 * half, [Part(material, around(0, half), (0, h), (0, 2 * half), kind)])
