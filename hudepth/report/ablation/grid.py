"""The weights of the loss's terms as a grid, where a sweep has one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from hudepth.report.ablation.factors import shown, spelt
from hudepth.report.ablation.row import Row

WEIGHTS = ("loss.boundary", "loss.smoothness", "loss.scaling")


@dataclass(frozen=True)
class Grid:
    """Rows that differ in nothing but the weights."""

    y: str
    """Names of the weights: down, across, and from panel to panel; the last is empty if it does not vary."""
    x: str
    panel: str
    ys: list[str]
    """Their values in letters, lowest first."""
    xs: list[str]
    panels: list[str]
    cells: dict[tuple[str, str, str], Row]
    """By value of panel, y and x."""


def find_grid(rows: Sequence[Row]) -> Grid | None:
    """Return the largest grid of weights among rows; None if no two weights have two values each.

    Rows that differ in something else, or lack a weight, are in no grid with the others.
    """
    groups: dict[tuple[tuple[str, str], ...], list[Row]] = {}
    for row in rows:
        config = row.variant.config
        if row.runs and all(key in config for key in WEIGHTS):
            rest = tuple((key, spelt(value)) for key, value in sorted(config.items()) if key not in WEIGHTS)
            groups.setdefault(rest, []).append(row)
    if not groups:
        return None
    group = max(groups.values(), key=len)
    values = {key: _values([row.variant.config[key] for row in group]) for key in WEIGHTS}
    varied = [key for key in WEIGHTS if len(values[key]) > 1]
    if len(varied) < 2:
        return None
    keys = [*varied, *(key for key in WEIGHTS if key not in varied)]  # y, x, panel
    cells = {
        (where[2] if len(varied) == 3 else "", where[0], where[1]): row
        for row in group
        for where in [[shown(row.variant.config[key]) for key in keys]]
    }
    names = [key.rpartition(".")[2] for key in keys]
    panels = values[keys[2]] if len(varied) == 3 else [""]
    return Grid(
        names[0], names[1], names[2] if len(varied) == 3 else "", values[keys[0]], values[keys[1]], panels, cells
    )


def _values(found: Sequence[Any]) -> list[str]:
    numbers = {spelt(value): value for value in found}
    order = sorted(
        numbers.values(), key=lambda v: (not isinstance(v, int | float), v if isinstance(v, int | float) else 0, str(v))
    )
    return list(dict.fromkeys(shown(value) for value in order))
