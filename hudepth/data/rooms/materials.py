"""Procedural textures fixed to the faces of solids, and the colours of a room."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hudepth.data.rooms.raycast import F32

Colour: TypeAlias = tuple[float, ...]
"""Linear RGB."""

_TABLE = 512


class Material(NamedTuple):
    """A texture that picks between two linear RGB colours at every point of a face."""

    pattern: str
    """A key of ``PATTERNS``; ``glow`` shines by itself, whatever light falls on it."""
    first: Colour
    second: Colour
    scale_m: float = 1.0
    """Size of a plank, tile, stripe or blotch."""


@cache
def _noise_table() -> F32:
    """Periodic noise [512, 512] in [0, 1] with a natural (1 / f) spectrum."""
    rng = np.random.default_rng(7)
    f = np.hypot(np.fft.fftfreq(_TABLE)[:, None], np.fft.fftfreq(_TABLE)[None]) * _TABLE
    spectrum = np.fft.fft2(rng.standard_normal((_TABLE, _TABLE))) / np.maximum(f, 2.0) ** 1.3
    noise = np.fft.ifft2(spectrum).real
    return np.asarray(np.clip(0.5 + 0.2 * (noise - noise.mean()) / noise.std(), 0, 1), np.float32)


def noise(u: F32, v: F32) -> F32:
    """Look up fractal noise [0, 1] at any points; it repeats every 512 units."""
    column, row = u.astype(np.int32) & (_TABLE - 1), v.astype(np.int32) & (_TABLE - 1)
    return np.asarray(_noise_table()[row, column])


def _fibres(u: F32, v: F32) -> F32:
    """As :func:`noise`, interpolated along v: otherwise the ends of long cells would show in wood grain."""
    row = np.floor(v)
    start, part = noise(u, row), v - row
    return start + (noise(u, row + 1) - start) * part


def _hash(cell: NDArray[np.int32]) -> F32:
    """Return a number in [0, 1) for each integer."""
    mixed = (cell.astype(np.uint32) * np.uint32(2654435761)) >> np.uint32(8)
    mixed = (mixed ^ (mixed >> np.uint32(11))) * np.uint32(2246822519)
    return (mixed >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def _wood(u: F32, v: F32, scale: F32, sharp: F32) -> F32:
    across = u / scale
    plank: F32 = np.floor(across)
    grain = _fibres(across * 60 + plank * 97, v * 22 + plank * 31)
    seam = ((across - plank) < 0.04) * sharp
    return np.asarray(0.65 * grain + 0.35 * _hash(plank.astype(np.int32)) + 0.6 * seam)


def _tiles(u: F32, v: F32, scale: F32, sharp: F32) -> F32:
    a, b = u / scale, v / scale
    i, j = np.floor(a), np.floor(b)
    grout = np.maximum((a - i) < 0.035, (b - j) < 0.035) * sharp
    return np.asarray(0.12 * _hash((i * 71 + j).astype(np.int32)) + 0.25 * noise(u * 90, v * 90) + 0.8 * grout)


def _stripes(u: F32, v: F32, scale: F32, sharp: F32) -> F32:
    wave: F32 = np.sin(u * (2 * np.pi) / scale) * sharp
    return 0.4 + 0.5 * wave + 0.2 * noise(u * 300, v * 300)


def _books(u: F32, v: F32, scale: F32, sharp: F32) -> F32:
    book = np.floor(u / scale + 0.6 * np.sin(u / scale)).astype(np.int32)
    colour: F32 = np.stack([_hash(book * 3 + c) for c in (0, 1, 2)])
    return np.asarray((0.6 * colour + 0.4 * _hash(book * 5 + 1)) ** 2 * (0.8 + 0.4 * noise(u * 40, v * 300)))


def _view(u: F32, v: F32, scale: F32, sharp: F32) -> F32:
    """Large soft shapes, brighter above: a painting, or what a screen shows."""
    return np.asarray(np.clip(3 * noise(u * 90 + 40, v * 90 + 90) - 1 + 0.8 * v / scale, 0, 1))


def _mottled(cells_per_m: float, strength: float, u: F32, v: F32, scale: F32, sharp: F32) -> F32:
    return 0.5 + strength * (noise(u * cells_per_m / scale, v * cells_per_m / scale) - 0.5)


PATTERNS: dict[str, Callable[[F32, F32, F32, F32], F32]] = {
    "plain": partial(_mottled, 35, 0.8),
    "glow": partial(_mottled, 35, 0.8),
    "fabric": partial(_mottled, 420, 1.4),
    "blotches": partial(_mottled, 60, 1.6),
    "wood": _wood,
    "tiles": _tiles,
    "stripes": _stripes,
    "books": _books,
    "view": _view,
}
"""How to compute each pattern of :class:`Material` from u, v, scale, and the sharpness of seams."""


def pattern_weight(material: Material, u: F32, v: F32, footprint: F32) -> F32:
    """Return how much of the second colour each point gets: [n], or [3, n] if every channel has its own.

    ``u`` and ``v`` [n] are metres along the face, ``v`` upwards on vertical faces. Seams and stripes finer than
    ``footprint`` [n], the size of a pixel on the face [m], fade out.
    """
    scale = np.array(material.scale_m, np.float32)
    return PATTERNS[material.pattern](u, v, scale, np.clip(scale / (4 * footprint + 1e-6), 0, 1))


# fmt: off
_WALLS: tuple[Colour, ...] = (
    (0.72, 0.68, 0.58), (0.75, 0.74, 0.70), (0.62, 0.66, 0.62),
    (0.66, 0.58, 0.44), (0.55, 0.62, 0.70), (0.70, 0.60, 0.52),
)
_WOODS: tuple[Colour, ...] = (
    (0.42, 0.24, 0.11), (0.20, 0.10, 0.05), (0.55, 0.38, 0.20),
    (0.30, 0.13, 0.06), (0.60, 0.48, 0.32), (0.62, 0.60, 0.56),
)
_FABRICS: tuple[Colour, ...] = (
    (0.10, 0.14, 0.26), (0.34, 0.08, 0.07), (0.30, 0.27, 0.22), (0.09, 0.16, 0.10),
    (0.46, 0.40, 0.30), (0.07, 0.07, 0.08), (0.20, 0.10, 0.05),
)
_ACCENTS: tuple[Colour, ...] = (
    (0.55, 0.07, 0.05), (0.06, 0.16, 0.42), (0.62, 0.45, 0.06), (0.08, 0.30, 0.12),
    (0.65, 0.60, 0.50), (0.35, 0.10, 0.28), (0.05, 0.35, 0.38), (0.60, 0.25, 0.06),
)
# fmt: on
_SAME_EVERYWHERE = {
    "ceiling": Material("plain", (0.80, 0.79, 0.76), (0.74, 0.73, 0.70)),
    "books": Material("books", (0.05, 0.04, 0.04), (0.75, 0.65, 0.55), 0.035),
    "tiles": Material("tiles", (0.68, 0.68, 0.64), (0.40, 0.40, 0.38), 0.15),
    "white": Material("plain", (0.78, 0.77, 0.74), (0.66, 0.65, 0.62)),
    "pillow": Material("fabric", (0.78, 0.76, 0.72), (0.60, 0.58, 0.55)),
    "trim": Material("plain", (0.74, 0.72, 0.67), (0.64, 0.62, 0.58)),
    "dark": Material("plain", (0.030, 0.030, 0.033), (0.018, 0.018, 0.02)),
    "metal": Material("plain", (0.42, 0.42, 0.43), (0.28, 0.28, 0.29)),
    "screen": Material("view", (0.01, 0.012, 0.016), (0.05, 0.07, 0.10), 6.0),
    "leaf": Material("blotches", (0.03, 0.10, 0.02), (0.12, 0.28, 0.06), 0.4),
    "cardboard": Material("plain", (0.46, 0.32, 0.18), (0.36, 0.24, 0.13)),
    "shade": Material("glow", (1.5, 1.2, 0.8), (1.1, 0.85, 0.5)),
    "lamp": Material("glow", (3.0, 2.8, 2.4), (3.0, 2.8, 2.4)),
    "sky": Material("glow", (3.0, 3.3, 3.7), (1.2, 1.6, 1.5), 0.4),
}


def room_materials(rng: np.random.Generator, category: str) -> dict[str, Material]:
    """Choose the colours of one room; every name a piece of furniture uses is a key."""

    def pick(colours: tuple[Colour, ...]) -> Colour:
        base = colours[int(rng.integers(len(colours)))]
        return tuple(float(c * rng.uniform(0.85, 1.15)) for c in base)

    def shades(pattern: str, colour: Colour, first: float, second: float, scale_m: float = 1.0) -> Material:
        one, other = (tuple(c * factor for c in colour) for factor in (first, second))
        return Material(pattern, one, other, scale_m)

    wall, wood, panel, fabric = pick(_WALLS), pick(_WOODS), pick(_WOODS), pick(_FABRICS)
    accent_wall = pick(_ACCENTS) if rng.random() < 0.25 else wall
    floors = {
        "wood": shades("wood", pick(_WOODS), 1.15, 0.55, 0.13),
        "tiles": shades("tiles", pick(_WALLS), 1, 0.45, float(rng.uniform(0.25, 0.5))),
        "carpet": shades("fabric", pick(_WALLS), 0.8, 0.45),
    }
    typical = {"kitchen": "tiles", "office": "carpet"}.get(category, "wood")
    floor = typical if rng.random() < 0.6 else str(rng.choice(list(floors)))
    if rng.random() < 0.4:
        panel = (0.70, 0.68, 0.64)
    cover, cover_scale_m = ("stripes", 0.12) if rng.random() < 0.35 else ("fabric", 1.0)
    accents = [pick(_ACCENTS) for _ in range(4)]
    rug = shades("stripes", pick(_FABRICS), 1.8, 1, float(rng.uniform(0.15, 0.5)))
    return {
        **_SAME_EVERYWHERE,
        "floor": floors[floor],
        "wall": shades("plain", wall, 1.06, 0.88),
        "accent_wall": shades("plain", accent_wall, 1.06, 0.88),
        "wood": shades("wood", wood, 1.2, 0.6, 0.35),
        "panel": shades("wood", panel, 1.1, 0.75, 0.6),
        "fabric": shades(cover, fabric, 1.5, 0.7, cover_scale_m),
        "rug": rug._replace(second=accents[3]),
        "worktop": shades("blotches", pick(_WOODS), 0.9, 0.4, 0.3),
        "curtain": shades("stripes", pick(_FABRICS), 2, 1, 0.11),
        "painting": Material("view", accents[0], accents[2]),
        "poster": Material("view", accents[1], (0.7, 0.65, 0.55), 1.5),
        **{f"accent{i}": shades("fabric", colour, 1.2, 0.7) for i, colour in enumerate(accents)},
    }
