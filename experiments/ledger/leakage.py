"""How many test frames of a video have a training frame next to them, when frames are split at random and by scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hudepth.data.sources.base import Record
from hudepth.data.splits import Split, make_split


def consecutive_records(n: int, *, frames_per_scene: int | None = None) -> list[Record]:
    """Name ``n`` frames in video order.

    Args:
        n: how many.
        frames_per_scene: length of each scene; None for one scene.
    """
    length = frames_per_scene or n
    return [
        Record(id=f"{i // length:04d}/{i % length:05d}", scene=f"{i // length:04d}", frame=i % length) for i in range(n)
    ]


def split_frames(
    n: int, *, kind: str, fractions: Sequence[float], seed: int, frames_per_scene: int | None = None
) -> Split:
    """Split :func:`consecutive_records` as :func:`hudepth.data.splits.make_split` does."""
    records = consecutive_records(n, frames_per_scene=frames_per_scene)
    return make_split(records, kind=kind, seed=seed, fractions=fractions)


def expected_share(train_fraction: float, *, within: int) -> float:
    """Return the chance that one of a frame's ``2 within`` neighbours is a training frame: 1 - (1 - f)^(2 within)."""
    return float(1 - (1 - train_fraction) ** (2 * within))


def share_next_to_training(split: Split, *, n: int, within: int, frames_per_scene: int | None = None) -> float:
    """Return the share of test frames with a training frame of their scene at most ``within`` frames away.

    Args:
        split: of :func:`consecutive_records`.
        n: number of frames.
        within: largest distance, in frames.
        frames_per_scene: as the records were made.
    """
    scene = np.arange(n) // (frames_per_scene or n)
    is_train = np.zeros(n, dtype=bool)
    is_train[split.train] = True
    test = np.asarray(split.test)
    adjacent = np.zeros(len(test), dtype=bool)
    for distance in [*range(-within, 0), *range(1, within + 1)]:
        neighbour = test + distance
        inside = (neighbour >= 0) & (neighbour < n)
        neighbour = neighbour.clip(0, n - 1)
        adjacent |= inside & is_train[neighbour] & (scene[neighbour] == scene[test])
    return float(adjacent.mean())
