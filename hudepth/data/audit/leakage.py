"""How near test frames lie to training frames, counted from records alone: no image is opened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hudepth.data.sources.base import Record
from hudepth.data.splits import Split

WITHIN = (1, 2, 5)
"""Distances [frames] up to which a training frame counts as a neighbour."""
UNKNOWN = -1
"""Distance of two frames of different scenes, or of a frame whose scene has no name."""


@dataclass(frozen=True)
class Leakage:
    """What a split lets a network see of the scenes of its test frames.

    Shares are of the test frames whose scene has a name, NaN if there are none.
    """

    counts: dict[str, int]
    """Pairs in train, val and test."""
    without_scene: int
    """Test frames whose scene has no name; the shares leave them out."""
    scene_seen: float
    """Share of test frames whose scene has frames in training."""
    within: dict[int, float]
    """Share of test frames with a training frame of their scene at most so many frames away."""
    mean_distance_frames: float
    """Mean distance to the nearest training frame of the scene, over test frames that have one; else NaN."""


class SceneOrder:
    """The place of each frame in its scene.

    Args:
        records: all pairs, in any order. Frames of a scene are sorted by number; equal numbers keep their order.
    """

    def __init__(self, records: Sequence[Record]) -> None:
        numbers: dict[str, int] = {}
        scenes = [numbers.setdefault(r.scene, len(numbers)) if r.scene else UNKNOWN for r in records]
        self.scene = np.array(scenes, np.int64)
        """[n] number of each frame's scene, :data:`UNKNOWN` where it has no name."""
        self._sorted = np.lexsort((np.array([record.frame for record in records], np.int64), self.scene))
        self._place = np.empty(len(records), np.int64)  # in a line of all frames, scene after scene
        self._place[self._sorted] = np.arange(len(records))

    def distance(self, one: int, other: int) -> int:
        """Return how many frames two frames are apart, :data:`UNKNOWN` unless they are of one scene."""
        if self.scene[one] != self.scene[other] or self.scene[one] == UNKNOWN:
            return UNKNOWN
        return int(abs(self._place[one] - self._place[other]))

    def nearest(self, train: Sequence[int]) -> NDArray[np.int64]:
        """Return how many frames each frame is from the nearest of ``train`` in its scene.

        Args:
            train: positions in the records.

        Returns:
            [n] distances, 0 for the frames of ``train``, :data:`UNKNOWN` where the scene has none of them.
        """
        n = len(self.scene)
        line, scene = np.arange(n), self.scene[self._sorted]
        in_train = np.zeros(n, bool)
        in_train[self._place[np.asarray(train, np.int64)]] = True
        before = np.maximum.accumulate(np.where(in_train, line, -1))
        after = np.minimum.accumulate(np.where(in_train, line, n)[::-1])[::-1]
        distance = np.full(n, n)  # farther than any frame
        for found in (before, after):
            same = (found >= 0) & (found < n) & (scene >= 0) & (scene[found.clip(0, n - 1)] == scene)
            distance = np.where(same, np.minimum(distance, np.abs(found - line)), distance)
        result = np.empty(n, np.int64)
        result[self._sorted] = np.where(distance < n, distance, UNKNOWN)
        return result


def leakage(records: Sequence[Record], split: Split) -> Leakage:
    """Count test frames near training frames of their scene.

    Distances are between places in the scene: its frames, of all subsets, are sorted by number and counted off. Two
    frames are one apart if the set has none between them, however much of the video was dropped there.

    Args:
        records: those the split was made of.
        split: positions in ``records``.
    """
    order = SceneOrder(records)
    test = np.asarray(split.test, np.int64)
    known = test[order.scene[test] != UNKNOWN]
    distance = order.nearest(split.train)[known]
    seen = distance != UNKNOWN
    nan = float("nan")
    return Leakage(
        counts={"train": len(split.train), "val": len(split.val), "test": len(split.test)},
        without_scene=len(test) - len(known),
        scene_seen=float(seen.mean()) if len(known) else nan,
        within={k: float((seen & (distance <= k)).mean()) if len(known) else nan for k in WITHIN},
        mean_distance_frames=float(distance[seen].mean()) if seen.any() else nan,
    )
