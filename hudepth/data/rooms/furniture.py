"""Tables, seats and beds for the built-in rooms.

A piece is a list of simple solids, with its back at z = 0 and its front towards +z.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np

from hudepth.data.rooms.raycast import BOX, CYLINDER, ELLIPSOID

Rng: TypeAlias = np.random.Generator
Span: TypeAlias = tuple[float, float]


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


ACCENTS = ("accent0", "accent1", "accent2", "accent3", "dark", "white")


def clutter(rng: Rng, x: Span, z: Span, y: float, *, most: int = 4) -> list[Part]:
    """Put a few boxes, cups and piles of books on a board at height ``y`` [m]."""
    parts = []
    slots = np.linspace(x[0], x[1], most + 1)
    for left, right in pairwise(slots):
        if rng.random() < 0.4:
            continue
        half = min(rng.uniform(0.04, 0.14), (right - left) / 2.2)
        middle = (left + right) / 2
        back = rng.uniform(z[0], max(z[0], z[1] - 2 * half))
        tall = rng.random() < 0.4
        kind = CYLINDER if tall else BOX
        half, height = (min(half, 0.05), rng.uniform(0.1, 0.28)) if tall else (half, rng.uniform(0.03, 0.14))
        parts.append(
            Part(
                str(rng.choice(ACCENTS)),
                (middle - half, middle + half),
                (y, y + height),
                (back, back + 2 * half),
                kind,
            )
        )
    return parts


def _legs(material: str, width: float, z: Span, top: float, thick: float) -> list[Part]:
    x = width / 2
    return [
        Part(material, xs, (0, top), zs)
        for xs in ((-x, -x + thick), (x - thick, x))
        for zs in ((z[0], z[0] + thick), (z[1] - thick, z[1]))
    ]


def table(rng: Rng, *, height: float = 0.74, width: Span = (1.1, 1.8), depth: Span = (0.75, 0.95)) -> Piece:
    """A table with four legs and things on it."""
    w, d, thick = rng.uniform(*width), rng.uniform(*depth), rng.uniform(0.04, 0.08)
    parts = [Part("wood", (-w / 2, w / 2), (height - 0.04, height), (0, d))]
    parts += _legs("wood", w - 0.06, (0.03, d - 0.03), height - 0.04, thick)
    return Piece(w, d, parts + clutter(rng, (-w / 2 + 0.1, w / 2 - 0.1), (0.08, d - 0.1), height))


def coffee_table(rng: Rng) -> Piece:
    """A low table with a shelf under its top."""
    piece = table(rng, height=rng.uniform(0.38, 0.46), width=(0.8, 1.2), depth=(0.5, 0.65))
    shelf = Part("wood", (-piece.width / 2 + 0.08, piece.width / 2 - 0.08), (0.12, 0.14), (0.08, piece.depth - 0.08))
    return Piece(piece.width, piece.depth, [*piece.parts, shelf])


def chair(rng: Rng) -> Piece:
    """A chair with a slatted back, facing +z."""
    w, d, seat = rng.uniform(0.4, 0.47), 0.44, rng.uniform(0.43, 0.48)
    parts = [Part(str(rng.choice(["wood", "accent0"])), (-w / 2, w / 2), (seat - 0.04, seat), (0, d))]
    parts += _legs("wood", w - 0.02, (0.01, d - 0.01), seat - 0.04, 0.035)
    for x in (-w / 2 + 0.01, -0.02, w / 2 - 0.05):
        parts.append(Part("wood", (x, x + 0.04), (seat, 0.86), (0.005, 0.03)))
    return Piece(w, d, [*parts, Part("wood", (-w / 2, w / 2), (0.8, 0.92), (0, 0.035))])


def office_chair(rng: Rng) -> Piece:
    """A swivel chair on a column and a round foot."""
    parts = [
        Part("dark", (-0.28, 0.28), (0.03, 0.07), (0, 0.56), CYLINDER),
        Part("metal", (-0.03, 0.03), (0.07, 0.44), (0.25, 0.31), CYLINDER),
        Part("fabric", (-0.24, 0.24), (0.44, 0.52), (0.05, 0.53)),
        Part("fabric", (-0.22, 0.22), (0.6, rng.uniform(0.95, 1.1)), (0.03, 0.1)),
        Part("dark", (-0.03, 0.03), (0.48, 0.65), (0.0, 0.03)),
    ]
    return Piece(0.56, 0.56, parts)


def sofa(rng: Rng) -> Piece:
    """A sofa with arms, seat and back cushions, and a pillow."""
    w, d, arm = rng.uniform(1.5, 2.3), rng.uniform(0.85, 0.95), rng.uniform(0.14, 0.22)
    n = 2 if w < 1.9 else 3
    parts = [
        Part("fabric", (-w / 2, w / 2), (0.06, 0.28), (0, d - 0.03)),
        Part("fabric", (-w / 2, w / 2), (0.28, 0.78), (0, 0.2)),
    ]
    parts += [Part("fabric", x, (0.28, 0.6), (0.2, d)) for x in ((-w / 2, -w / 2 + arm), (w / 2 - arm, w / 2))]
    edges = np.linspace(-w / 2 + arm, w / 2 - arm, n + 1)
    for left, right in pairwise(edges):
        parts.append(Part("fabric", (left + 0.01, right - 0.01), (0.28, 0.43), (0.2, d)))
        parts.append(Part("fabric", (left + 0.02, right - 0.02), (0.43, 0.84), (0.2, 0.34)))
    side = rng.choice([-1, 1]) * (w / 2 - arm - 0.22)
    parts.append(Part("accent1", (side - 0.2, side + 0.2), (0.42, 0.76), (0.32, 0.5), ELLIPSOID))
    return Piece(w, d, parts)


def bed(rng: Rng) -> Piece:
    """A bed with a headboard at the wall, a blanket and pillows."""
    w, d, top = rng.uniform(1.0, 1.8), rng.uniform(1.95, 2.1), rng.uniform(0.45, 0.6)
    parts = [
        Part("wood", (-w / 2, w / 2), (0.08, 0.28), (0, d)),
        Part("wood", (-w / 2, w / 2), (0, rng.uniform(0.85, 1.15)), (0, 0.06)),
        Part("white", (-w / 2 + 0.02, w / 2 - 0.02), (0.28, top), (0.06, d - 0.02)),
        Part("fabric", (-w / 2 - 0.01, w / 2 + 0.01), (0.24, top + 0.04), (d * 0.38, d + 0.01)),
        Part("accent1", (-w / 2 - 0.015, w / 2 + 0.015), (0.26, top + 0.06), (d * 0.36, d * 0.52)),
    ]
    middles = [0.0] if w < 1.3 else [-w / 4, w / 4]
    parts += [Part("pillow", (x - 0.33, x + 0.33), (top - 0.06, top + 0.16), (0.1, 0.52), ELLIPSOID) for x in middles]
    return Piece(w, d, parts)


def desk(rng: Rng) -> Piece:
    """A desk with a drawer unit, a monitor, a keyboard and a chair before it."""
    w, d, side = rng.uniform(1.2, 1.6), rng.uniform(0.65, 0.8), rng.choice([-1, 1])
    x = side * (w / 2 - 0.24)
    parts = [
        Part("wood", (-w / 2, w / 2), (0.71, 0.74), (0, d)),
        Part("wood", (x - 0.2, x + 0.2), (0.02, 0.71), (0.05, d - 0.06)),
        *(Part("panel", (x - 0.19, x + 0.19), (low, low + 0.2), (d - 0.06, d - 0.04)) for low in (0.06, 0.27, 0.48)),
        Part("dark", (-0.28, 0.28), (0.86, 1.2), (0.2, 0.23)),
        Part("screen", (-0.26, 0.26), (0.88, 1.18), (0.23, 0.235)),
        Part("dark", (-0.03, 0.03), (0.74, 0.9), (0.17, 0.2)),
        Part("dark", (-0.12, 0.12), (0.74, 0.755), (0.1, 0.28)),
        Part("dark", (-0.22, 0.22), (0.74, 0.76), (d - 0.28, d - 0.14)),
    ]
    parts += [Part("metal", (-x - 0.02, -x + 0.02), (0, 0.71), z) for z in ((0.05, 0.09), (d - 0.1, d - 0.06))]
    parts += clutter(rng, (0.32, w / 2), (0.1, d - 0.1), 0.74, most=2)
    seat = [part._replace(z=(d + 0.42 - part.z[1], d + 0.42 - part.z[0])) for part in office_chair(rng).parts]
    return Piece(w, d + 0.45, parts + seat)


def dining_set(rng: Rng) -> Piece:
    """A table with chairs along both long sides."""
    middle = table(rng)
    reach = 0.3
    parts = [part._replace(z=(part.z[0] + reach, part.z[1] + reach)) for part in middle.parts]
    model = chair(rng)
    for x in (-middle.width / 4, middle.width / 4):
        for facing in (1, -1):
            gap = rng.uniform(-0.05, 0.12)
            for part in model.parts:
                z = (part.z[0] - gap, part.z[1] - gap)
                if facing < 0:
                    z = (2 * reach + middle.depth - z[1], 2 * reach + middle.depth - z[0])
                parts.append(part._replace(x=(part.x[0] + x, part.x[1] + x), z=z))
    return Piece(middle.width, middle.depth + 2 * reach, parts)


def carton(rng: Rng) -> Piece:
    """A box, a stool or a bin on the floor."""
    half, h = rng.uniform(0.15, 0.28), rng.uniform(0.25, 0.5)
    kind = CYLINDER if rng.random() < 0.4 else BOX
    material = str(rng.choice(["cardboard", *ACCENTS]))
    return Piece(2 * half, 2 * half, [Part(material, (-half, half), (0, h), (0, 2 * half), kind)])
