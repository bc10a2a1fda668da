"""Leakage compared with plain loops and with the chances of a random split; the worst leaks of hand-made sets."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.data.audit.duplicates import find_duplicates
from hudepth.data.audit.leakage import UNKNOWN, Leak, Leakage, SceneOrder, find_worst_leaks, measure_leakage
from hudepth.data.sources.base import Record
from hudepth.data.sources.densedepth import DenseDepthSource
from hudepth.data.splits import Split, make_split

PLACES = st.lists(
    st.tuples(st.sampled_from(["", "a", "b", "c"]), st.integers(0, 9), st.sampled_from(["train", "val", "test"])),
    min_size=1,
    max_size=30,
)


def set_of(places: Sequence[tuple[str, int, str]]) -> tuple[list[Record], Split]:
    records = [Record(id=str(i), scene=scene, frame=frame) for i, (scene, frame, _) in enumerate(places)]
    subsets = {name: [i for i, place in enumerate(places) if place[2] == name] for name in ("train", "val", "test")}
    return records, Split("random", 0, (0.7, 0.1, 0.2), **subsets, sha256="")


def distance_by_loop(records: Sequence[Record], one: int, other: int) -> int:
    if records[one].scene != records[other].scene or not records[one].scene:
        return UNKNOWN
    frames = [i for i, record in enumerate(records) if record.scene == records[one].scene]
    frames.sort(key=lambda i: records[i].frame)
    return abs(frames.index(one) - frames.index(other))


@given(places=PLACES)
def test_leakage_agrees_with_a_loop(places: list[tuple[str, int, str]]) -> None:
    records, split = set_of(places)
    found = measure_leakage(records, split)
    nearest = []
    for test in split.test:
        if records[test].scene:
            apart = [distance_by_loop(records, test, train) for train in split.train]
            nearest.append(min((d for d in apart if d != UNKNOWN), default=None))
    seen = [distance for distance in nearest if distance is not None]
    assert found.counts == {name: len(split[name]) for name in ("train", "val", "test")}
    assert found.without_scene == len(split.test) - len(nearest)
    if not nearest:
        assert math.isnan(found.scene_seen)
        assert all(math.isnan(share) for share in found.within.values())
        return
    assert found.scene_seen == pytest.approx(len(seen) / len(nearest))
    for k in (1, 2, 5):
        assert found.within[k] == pytest.approx(sum(distance <= k for distance in seen) / len(nearest))
    if seen:
        assert found.mean_distance_frames == pytest.approx(sum(seen) / len(seen))
    else:
        assert math.isnan(found.mean_distance_frames)


@given(places=PLACES)
def test_distances_agree_with_a_loop(places: list[tuple[str, int, str]]) -> None:
    records, split = set_of(places)
    order = SceneOrder(records)
    everything = range(len(records))
    for one in everything:
        assert [order.distance(one, j) for j in everything] == [distance_by_loop(records, one, j) for j in everything]
    nearest = order.nearest(split.train)
    for one in everything:
        apart = [d for d in (distance_by_loop(records, one, train) for train in split.train) if d != UNKNOWN]
        assert nearest[one] == min(apart, default=UNKNOWN)


def test_frames_are_counted_off_in_their_scene() -> None:
    places = [("a", 90, "test"), ("a", 10, "train"), ("a", 20, "val"), ("b", 11, "test"), ("", 0, "test")]
    found = measure_leakage(*set_of(places))
    assert found == Leakage(
        counts={"train": 1, "val": 1, "test": 3},
        without_scene=1,
        scene_seen=0.5,
        within={1: 0, 2: 0.5, 5: 0.5},  # 10, 20, 90: two places
        mean_distance_frames=2,
    )


@pytest.fixture(scope="session")
def video_records(tmp_path_factory: pytest.TempPathFactory) -> Sequence[Record]:
    """Some 18,000 frames of 100 scenes, in DenseDepth's list alone, shuffled as it is."""
    rng = random.Random(0)
    names = [
        f"data/nyu2_train/room_{scene:04d}_out/{frame}"
        for scene in range(100)
        for frame in range(1, 1 + rng.randint(150, 212))
    ]
    rng.shuffle(names)
    folder = tmp_path_factory.mktemp("list")
    (folder / "nyu2_train.csv").write_text("".join(f"{name}.jpg,{name}.png\n" for name in names), encoding="utf-8")
    return DenseDepthSource(folder).records()


def test_a_random_split_of_video_leaks_as_chance_has_it(video_records: Sequence[Record]) -> None:
    assert len(video_records) > 17_000
    found = measure_leakage(video_records, make_split(video_records, kind="random"))
    assert found.scene_seen == 1
    # Each of 2 k neighbours is in training with chance 0.7; first and last frames of a scene have fewer.
    assert found.within[1] == pytest.approx(1 - 0.3**2, abs=0.015)
    assert found.within[2] == pytest.approx(1 - 0.3**4, abs=0.006)
    assert found.within[5] == pytest.approx(1, abs=0.002)
    assert found.mean_distance_frames == pytest.approx(sum(0.3 ** (2 * k) for k in range(8)), abs=0.02)


def test_a_split_by_scene_leaks_no_scene(video_records: Sequence[Record]) -> None:
    found = measure_leakage(video_records, make_split(video_records, kind="scene"))
    assert found.scene_seen == 0
    assert set(found.within.values()) == {0}
    assert math.isnan(found.mean_distance_frames)


def chosen(
    places: list[tuple[str, int]], train: list[int], test: list[int], hashes: list[int], *, rows: int = 6
) -> list[Leak]:
    records = [Record(id=str(i), scene=scene, frame=frame) for i, (scene, frame) in enumerate(places)]
    split = Split("random", 0, (0.7, 0.1, 0.2), train, [], test, "")
    array = np.array(hashes, np.uint64)
    digests = [str(value).encode() for value in hashes]  # equal hashes, equal pixels
    return find_worst_leaks(records, split, find_duplicates(split, array, digests), array, rows=rows)


FAR = 2**64 - 1


def test_near_duplicates_come_before_roommates_and_strangers() -> None:
    places = [("a", 0), ("b", 0), ("c", 0), ("x", 0), ("b", 1), ("a", 5)]
    hashes = [0, 0xFFFF, 0xFFFF0000, 0xFFFF << 40, FAR ^ 0xFF, 0b11]
    found = chosen(places, [0, 1, 2], [3, 4, 5], hashes)
    assert [(leak.test, leak.train) for leak in found] == [(5, 0), (4, 1), (3, 0)]
    assert [leak.near for leak in found] == [True, False, False]
    assert [leak.frames_apart for leak in found] == [1, 1, None]
    assert [leak.bits for leak in found] == [2, 56, 16]


def test_a_near_duplicate_in_another_scene_is_shown_as_such() -> None:
    (found,) = chosen([("a", 0), ("b", 0), ("a", 1)], [0, 1], [2], [FAR, 1, 1])
    assert (found.train, found.equal, found.frames_apart) == (1, True, None)


def test_a_scene_comes_again_only_after_the_others() -> None:
    places = [("a", 0), ("b", 0), ("a", 1), ("a", 2), ("b", 1)]
    hashes = [0, 0xFF00, 0b1, 0b11, 0xFF07]
    found = chosen(places, [0, 1], [2, 3, 4], hashes)
    assert [leak.test for leak in found] == [2, 4, 3]
    assert [leak.test for leak in chosen(places, [0, 1], [2, 3, 4], hashes, rows=2)] == [2, 4]


def test_frames_without_a_scene_are_no_roommates() -> None:
    found = chosen([("", 0), ("a", 0), ("", 1), ("", 2)], [0, 1], [2, 3], [FAR, 0xFFFF, 0, 0])
    assert [leak.frames_apart for leak in found] == [None, None]
    assert [leak.train for leak in found] == [1, 1]
