"""Which test images leak worst: what a split shares with training, image by image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hudepth.data.audit.hashes import NEAR_BITS, Duplicates, nearest_hashes
from hudepth.data.audit.leakage import UNKNOWN, Leakage, SceneOrder
from hudepth.data.sources.base import Record
from hudepth.data.splits import Split

ROWS = 6
"""Leaks shown in the picture."""


@dataclass(frozen=True)
class Audited:
    """A kind of split and what it leaks."""

    split: Split
    leak: Leakage
    copies: Duplicates | None
    """None if the images were not looked at."""


def worst_leaks(
    records: Sequence[Record], audited: Audited, hashes: NDArray[np.uint64], *, rows: int = ROWS
) -> list[dict[str, Any]]:
    """Choose test images that training knows best, each with the training image that gives it away.

    That is the near duplicate, where there is one; else the most similar training image of the same scene; else the
    most similar of all. They come in this order, then by hash, then by distance; a scene comes a second time only
    after all others have come once.

    Args:
        records: of the store.
        audited: a split, with its duplicates.
        hashes: [n] of all images of the store.
        rows: how many to choose.
    """
    order, copies = SceneOrder(records), audited.copies
    assert copies is not None
    train = np.asarray(audited.split.train, np.int64)
    train_scene = order.scene[train]
    found: list[dict[str, Any]] = []
    for row, test in enumerate(audited.split.test):
        nearest, bits = int(copies.nearest[row]), int(copies.bits[row])
        roommates = train[(train_scene == order.scene[test]) & (train_scene != UNKNOWN)]
        if bits > NEAR_BITS and len(roommates):
            position, differing = nearest_hashes(hashes[[test]], hashes[roommates])
            nearest, bits = int(roommates[position[0]]), int(differing[0])
        frames = order.distance(test, nearest)
        found.append(
            {
                "test": test,
                "train": nearest,
                "equal": bool(copies.equal[row]),
                "near": bits <= NEAR_BITS,
                "bits": bits,
                "frames_apart": None if frames == UNKNOWN else frames,
            }
        )
    found.sort(key=_harmlessness)
    times: Counter[str] = Counter()
    turns: list[int] = []
    for leak in found:
        scene = records[leak["test"]].scene or records[leak["test"]].id
        turns.append(times[scene])
        times[scene] += 1
    return [found[i] for i in np.argsort(turns, kind="stable")[:rows]]


def _harmlessness(leak: Mapping[str, Any]) -> tuple[int, ...]:
    frames = leak["frames_apart"]
    return not leak["equal"], not leak["near"], frames is None, leak["bits"], frames or 0
