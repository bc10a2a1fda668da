"""What a split leaks: how close test frames are to training frames, counted from records, and the worst pairs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hudepth.data.audit.duplicates import NEAR_BITS, Duplicates, find_nearest_hashes
from hudepth.data.sources.base import Record
from hudepth.data.splits import Split

WITHIN = (1, 2, 5)
"""Distances [frames] up to which a training frame counts as a neighbour."""
UNKNOWN = -1
"""Distance between frames of different scenes, or of a frame whose scene has no name."""


@dataclass(frozen=True)
class Leakage:
    """How much of the test frames' scenes training sees; shares are NaN if no test frame's scene has a name."""

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


@dataclass(frozen=True)
class AuditedSplit:
    """A split and what it leaks; ``copies`` is None if the images were not read."""

    split: Split
    leak: Leakage
    copies: Duplicates | None


@dataclass(frozen=True)
class Leak:
    """A test image and the training image that gives it away, by position; ``equal`` in pixels, ``near`` duplicates."""

    test: int
    train: int
    equal: bool
    near: bool
    bits: int
    """Bits in which their hashes differ."""
    frames_apart: int | None
    """None in different scenes."""


class SceneOrder:
    """The place of each frame in its scene; frames are sorted by number, and equal numbers keep their order."""

    def __init__(self, records: Sequence[Record]) -> None:
        numbers: dict[str, int] = {}
        scenes = [numbers.setdefault(r.scene, len(numbers)) if r.scene else UNKNOWN for r in records]
        self.scene = np.array(scenes, np.int64)
        """[n] number of each frame's scene, :data:`UNKNOWN` if it has no name."""
        self._sorted = np.lexsort((np.array([record.frame for record in records], np.int64), self.scene))
        self._place = np.empty(len(records), np.int64)  # in a line of all frames, scene after scene
        self._place[self._sorted] = np.arange(len(records))

    def distance(self, one: int, other: int) -> int:
        """Return how many frames two frames are apart, :data:`UNKNOWN` if they are not of one scene."""
        if self.scene[one] != self.scene[other] or self.scene[one] == UNKNOWN:
            return UNKNOWN
        return int(abs(self._place[one] - self._place[other]))

    def nearest(self, train: Sequence[int]) -> NDArray[np.int64]:
        """Return the distance [n] of each frame from the nearest of ``train`` in its scene.

        It is 0 for the frames of ``train``, :data:`UNKNOWN` if the scene has none of them.
        """
        n = len(self.scene)
        if not len(train):
            return np.full(n, UNKNOWN)
        places = np.sort(self._place[np.asarray(train, np.int64)])
        after = np.searchsorted(places, self._place)
        distance = np.full(n, n)
        for found in (places[(after - 1).clip(min=0)], places[after.clip(max=len(places) - 1)]):
            same = (self.scene[self._sorted[found]] == self.scene) & (self.scene != UNKNOWN)
            distance = np.where(same, np.minimum(distance, np.abs(found - self._place)), distance)
        return np.where(distance < n, distance, UNKNOWN)


def measure_leakage(records: Sequence[Record], split: Split) -> Leakage:
    """Count test frames near training frames of their scene; no image is read.

    Distances are between places in the scene: its frames, of all subsets, are sorted by number and counted off. Two
    frames are one apart if the set has none between them, however much of the video was dropped there.
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


def find_worst_leaks(
    records: Sequence[Record], split: Split, copies: Duplicates, hashes: NDArray[np.uint64], *, rows: int = 6
) -> list[Leak]:
    """Choose the ``rows`` test images that training gives away most, each with one training image.

    That is the near duplicate if there is one, else the most similar training image of the same scene, else the most
    similar of all. They come in this order, then by hash, then by distance; a scene comes a second time only after
    all others have come once. ``hashes`` [n] are those of all images of the store.
    """
    order = SceneOrder(records)
    train = np.asarray(split.train, np.int64)
    train_scene = order.scene[train]
    leaks = []
    for row, test in enumerate(split.test):
        nearest, bits = int(copies.nearest[row]), int(copies.bits[row])
        same_scene = train[(train_scene == order.scene[test]) & (train_scene != UNKNOWN)]
        if bits > NEAR_BITS and len(same_scene):
            position, differing = find_nearest_hashes(hashes[[test]], hashes[same_scene])
            nearest, bits = int(same_scene[position[0]]), int(differing[0])
        frames = order.distance(test, nearest)
        apart = None if frames == UNKNOWN else frames
        leaks.append(Leak(test, nearest, bool(copies.equal[row]), bits <= NEAR_BITS, bits, apart))
    leaks.sort(
        key=lambda leak: (not leak.equal, not leak.near, leak.frames_apart is None, leak.bits, leak.frames_apart)
    )
    times: Counter[str] = Counter()
    turns = []
    for leak in leaks:
        scene = records[leak.test].scene or records[leak.test].id
        turns.append(times[scene])
        times[scene] += 1
    return [leaks[i] for i in np.argsort(turns, kind="stable")[:rows]]
