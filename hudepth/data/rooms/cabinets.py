"""Cabinets and appliances, built as in :mod:`hudepth.data.rooms.furniture`."""

from __future__ import annotations

from itertools import product

import numpy as np

from hudepth.data.rooms.furniture import Part, Piece, Rng, Span, around, clutter
from hudepth.data.rooms.raycast import CYLINDER


def _doors(width: float, y: Span, front: float, *, columns: int, rows: int = 1) -> list[Part]:
    """Panels in front of a carcass with gaps between them, and a handle on each."""
    parts = []
    w, h = width / columns, (y[1] - y[0]) / rows
    for c, r in product(range(columns), range(rows)):
        left, low = -width / 2 + c * w, y[0] + r * h
        panel_x, panel_y = (left + 0.006, left + w - 0.006), (low + 0.006, low + h - 0.006)
        parts.append(Part("panel", panel_x, panel_y, (front, front + 0.02)))
        drawer = (left + w / 2, low + h * 0.8)
        handle_x, handle_y = drawer if rows > 1 else (left + w * (0.9 - 0.8 * (c % 2)), low + h / 2)
        parts.append(Part("metal", around(handle_x, 0.05), around(handle_y, 0.01), (front + 0.02, front + 0.04)))
    return parts


def shelf(rng: Rng) -> Piece:
    """An open bookcase with rows of books and a few other things."""
    w, d, height = rng.uniform(0.7, 1.2), rng.uniform(0.28, 0.36), rng.uniform(1.5, 2.1)
    parts = [Part("wood", x, (0, height), (0, d)) for x in ((-w / 2, -w / 2 + 0.025), (w / 2 - 0.025, w / 2))]
    parts.append(Part("wood", around(0, w / 2), (0, height), (0, 0.012)))
    boards = np.linspace(0.06, height - 0.02, int(rng.integers(4, 7)))
    inner = w / 2 - 0.03
    for low, high in zip(boards, [*boards[1:], None], strict=True):
        parts.append(Part("wood", around(0, inner + 0.005), (low, low + 0.022), (0, d - 0.005)))
        if high is None:
            break
        end = rng.uniform(-inner * 0.2, inner)
        top = low + (high - low) * rng.uniform(0.6, 0.88)
        if rng.random() < 0.8:
            parts.append(Part("books", (-inner, end), (low + 0.022, top), (0.02, d - rng.uniform(0.02, 0.1))))
        if end < inner - 0.2:
            parts += clutter(rng, (end + 0.02, inner), (0.04, d), low + 0.022, most=1)
    return Piece(w, d, parts)


def cabinet(
    rng: Rng, *, height: Span = (0.7, 1.1), width: Span = (0.7, 1.3), depth: Span = (0.38, 0.5), rows: int = 0
) -> Piece:
    """A cabinet or chest of drawers with things on top."""
    w, d, h = rng.uniform(*width), rng.uniform(*depth), rng.uniform(*height)
    front = d - 0.045
    parts = [
        Part("wood", around(0, w / 2 - 0.03), (0, 0.07), (0.02, front - 0.04)),
        Part("wood", around(0, w / 2), (0.07, h - 0.025), (0, front)),
        Part("wood", around(0, w / 2 + 0.01), (h - 0.025, h), (0, d)),
    ]
    drawers = rows or (int(rng.integers(3, 5)) if rng.random() < 0.5 else 1)
    parts += _doors(w, (0.08, h - 0.03), front, columns=max(1, round(w / 0.5)), rows=drawers)
    if h < 1.5:
        parts += clutter(rng, around(0, w / 2 - 0.05), (0.05, d - 0.08), h)
    return Piece(w, d, parts)


def wardrobe(rng: Rng) -> Piece:
    """A tall cabinet with doors."""
    return cabinet(rng, height=(1.85, 2.15), width=(1.0, 1.7), depth=(0.55, 0.62), rows=1)


def _clear_top(piece: Piece) -> tuple[float, list[Part]]:
    """Return the height of a cabinet's top [m], and its parts without what lies on it."""
    h = piece.parts[2].y[1]
    return h, [part for part in piece.parts if part.y[0] < h - 1e-6]


def nightstand(rng: Rng) -> Piece:
    """A small chest of drawers with a table lamp."""
    piece = cabinet(rng, height=(0.5, 0.62), width=(0.4, 0.5), depth=(0.38, 0.42), rows=2)
    h, parts = _clear_top(piece)
    parts.append(Part("metal", around(0, 0.05), (h, h + 0.28), (0.13, 0.23), CYLINDER))
    parts.append(Part("shade", around(0, 0.13), (h + 0.25, h + 0.46), (0.05, 0.31), CYLINDER))
    return piece._replace(parts=parts)


def television(rng: Rng) -> Piece:
    """A television on a low cabinet."""
    piece = cabinet(rng, height=(0.42, 0.55), width=(1.2, 1.7), rows=2)
    h, parts = _clear_top(piece)
    half = rng.uniform(0.45, 0.6)
    parts.append(Part("dark", around(0, half), (h + 0.08, h + 0.08 + half * 1.15), (0.12, 0.17)))
    parts.append(Part("screen", around(0, half - 0.03), (h + 0.11, h + 0.05 + half * 1.15), (0.17, 0.172)))
    parts.append(Part("dark", around(0, 0.2), (h, h + 0.1), (0.1, 0.2)))
    return piece._replace(parts=parts)


def counter(rng: Rng) -> Piece:
    """A kitchen counter with wall cabinets over it."""
    w, d = rng.uniform(1.6, 2.8), 0.62
    n = round(w / 0.55)
    oven = w / 2 - w / n
    parts = [
        Part("dark", around(0, w / 2), (0, 0.1), (0, d - 0.1)),
        Part("panel", around(0, w / 2), (0.1, 0.87), (0, d - 0.05)),
        Part("worktop", around(0, w / 2 + 0.01), (0.87, 0.91), (0, d)),
        Part("tiles", around(0, w / 2), (0.91, 1.45), (0, 0.008)),
        Part("panel", around(0, w / 2), (1.45, 2.1), (0, 0.33)),
        *_doors(w, (0.11, 0.86), d - 0.05, columns=n),
        *_doors(w, (1.46, 2.09), 0.33, columns=n),
        *clutter(rng, around(0, w / 2 - 0.1), (0.06, d - 0.2), 0.91, most=6),
        Part("dark", (oven + 0.04, w / 2 - 0.04), (0.25, 0.72), (d - 0.03, d - 0.02)),
        Part("dark", (oven + 0.02, w / 2 - 0.02), (0.91, 0.918), (0.08, d - 0.08)),
    ]
    return Piece(w, d, parts)


def fridge(rng: Rng) -> Piece:
    """A fridge with a freezer door."""
    w, d, h, split = rng.uniform(0.58, 0.75), 0.66, rng.uniform(1.6, 1.85), rng.uniform(0.5, 1.2)
    skin = str(rng.choice(["metal", "white"]))
    parts = [Part(skin, around(0, w / 2), (0.03, h), (0, d - 0.06))]
    for low, high in ((0.06, split), (split + 0.015, h)):
        parts.append(Part(skin, around(0, w / 2), (low, high), (d - 0.055, d)))
        parts.append(Part("dark", (-w / 2 + 0.04, -w / 2 + 0.06), (low + 0.15, high - 0.15), (d, d + 0.03)))
    return Piece(w, d + 0.03, parts)
