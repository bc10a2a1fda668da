"""Splits: the paper's counts, torch's permutation, scenes kept apart, and a hash that notices any change."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.sources.base import Record
from hudepth.data.splits import SUBSETS, Split, load_split, make_split, save_split, split_counts

PAPER = (0.7, 0.1, 0.2)


def frames(scenes: Sequence[int], *, split: str = "") -> list[Record]:
    """Records of as many scenes, each with so many frames."""
    return [
        Record(id=f"{split}{scene:03d}/{frame:03d}", scene=f"{split}{scene:03d}", frame=frame, split=split)
        for scene, count in enumerate(scenes)
        for frame in range(count)
    ]


def scenes_of(records: Sequence[Record], indices: Sequence[int]) -> set[str]:
    return {records[i].scene for i in indices}


SCENES = st.lists(st.integers(1, 8), min_size=40, max_size=80)
FRACTIONS = st.sampled_from([PAPER, (0.8, 0.1, 0.1), (1 / 3, 1 / 3, 1 / 3), (0.34, 0.33, 0.33)])


def test_the_papers_counts() -> None:
    assert split_counts(50_688, PAPER) == (35_481, 5_068, 10_139)
    split = make_split(frames([50_688]), kind="random")
    assert [len(split[name]) for name in SUBSETS] == [35_481, 5_068, 10_139]


@given(n=st.integers(10, 300), seed=st.integers(0, 2**40))
def test_random_is_torchs_random_split(n: int, seed: int) -> None:
    split = make_split(frames([n]), kind="random", seed=seed)
    counts = split_counts(n, PAPER)
    oracle = torch.utils.data.random_split(range(n), counts, torch.Generator().manual_seed(seed))  # type: ignore[arg-type]
    assert [split[name] for name in SUBSETS] == [list(subset.indices) for subset in oracle]


@given(scenes=SCENES, seed=st.integers(0, 99), fractions=FRACTIONS)
def test_scenes_are_kept_apart_and_sizes_come_near(
    scenes: list[int], seed: int, fractions: tuple[float, float, float]
) -> None:
    records = frames(scenes)
    assume(min(fractions) * len(records) > 2 * max(scenes))  # else a subset may be left empty
    split = make_split(records, kind="scene", seed=seed, fractions=fractions)
    assert sorted(split.train + split.val + split.test) == list(range(len(records)))
    parts = [scenes_of(records, split[name]) for name in SUBSETS]
    assert sum(map(len, parts)) == len(set.union(*parts)) == len(scenes)
    for share, name in zip(fractions, SUBSETS, strict=True):
        excess = len(split[name]) - share * len(records)
        # Only a subset that lacks frames is dealt a scene, so none exceeds its share by a whole one.
        assert -2 * max(scenes) < excess < max(scenes)
        assert split[name] == sorted(split[name])


@given(scenes=SCENES, tests=st.lists(st.integers(1, 5), min_size=1, max_size=5), seed=st.integers(0, 99))
def test_official_keeps_the_sets_own_test(scenes: list[int], tests: list[int], seed: int) -> None:
    own = frames(scenes, split="train")
    assume(len(own) / 8 > max(scenes))
    records = frames(tests, split="test") + own
    split = make_split(records, kind="official", seed=seed)
    n_test = sum(tests)
    assert split.test == list(range(n_test))
    assert sorted(split.train + split.val) == list(range(n_test, len(records)))
    assert not scenes_of(records, split.train) & scenes_of(records, split.val)
    assert abs(len(split.val) - len(own) / 8) < max(scenes)  # 0.1 of 0.7 + 0.1


@pytest.mark.parametrize("kind", ["random", "scene", "official"])
def test_every_record_is_in_one_subset_and_the_seed_decides_which(kind: str) -> None:
    records = frames([3] * 20, split="train") + frames([3] * 5, split="test")
    split = make_split(records, kind=kind, seed=7)
    assert sorted(split.train + split.val + split.test) == list(range(75))
    assert split == make_split(records, kind=kind, seed=7)
    assert split.sha256 != make_split(records, kind=kind, seed=8).sha256
    assert (split.kind, split.seed, split.fractions) == (kind, 7, PAPER)


def test_scene_splits_do_not_depend_on_the_order_of_records() -> None:
    records = frames([3] * 20)
    turned = records[::-1]
    one, two = make_split(records, kind="scene"), make_split(turned, kind="scene")
    for name in SUBSETS:
        assert {records[i].id for i in one[name]} == {turned[i].id for i in two[name]}


def test_summary() -> None:
    split = make_split(frames([100]), kind="random", seed=3)
    assert split.summary() == {
        "kind": "random",
        "seed": 3,
        "fractions": [0.7, 0.1, 0.2],
        "counts": {"train": 70, "val": 10, "test": 20},
        "sha256": split.sha256,
    }
    json.dumps(split.summary())


@given(places=st.lists(st.integers(0, 39), min_size=2, max_size=2, unique=True))
def test_the_hash_changes_when_any_two_ids_change_places(places: list[int]) -> None:
    records, (i, j) = frames([40]), places
    swapped = list(records)
    swapped[i], swapped[j] = records[j], records[i]
    assert make_split(records, kind="random").sha256 != make_split(swapped, kind="random").sha256


def test_the_hash_changes_when_an_id_moves_to_the_next_subset() -> None:
    records = frames([5])
    some = {make_split(records, kind="random", fractions=(a / 5, b / 5, (5 - a - b) / 5)).sha256
            for a in (1, 2, 3) for b in (1, 2, 3) if a + b < 5}  # fmt: skip
    assert len(some) == 6


def test_the_hash_is_over_the_ids_alone() -> None:
    records = frames([20])
    others = [replace(record, frame=record.frame + 1, category="kitchen") for record in records]
    assert make_split(records, kind="random").sha256 == make_split(others, kind="random").sha256
    # Written down: a changed hash would disown every saved split.
    assert make_split(frames([10]), kind="random").sha256 == EXPECTED_SHA256


EXPECTED_SHA256 = "753292325f3c8a518a624cf41a527a36e2033fe95b797718e9fb574aa922d71d"


@pytest.mark.parametrize("kind", ["random", "scene", "official"])
def test_a_saved_split_comes_back(tmp_path: Path, kind: str) -> None:
    records = frames([3] * 20, split="train") + frames([3] * 5, split="test")
    split = make_split(records, kind=kind, seed=5)
    save_split(tmp_path / "split.json", split, records)
    assert load_split(tmp_path / "split.json", records) == split


def test_a_saved_split_finds_its_pairs_in_another_order(tmp_path: Path) -> None:
    records = frames([30])
    split = make_split(records, kind="random")
    save_split(tmp_path / "split.json", split, records)
    more = frames([1], split="new") + records[::-1]
    found = load_split(tmp_path / "split.json", more)
    assert found.sha256 == split.sha256
    for name in SUBSETS:
        assert [more[i].id for i in found[name]] == [records[i].id for i in split[name]]


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Path, list[Record], Split]:
    records = frames([30])
    split = make_split(records, kind="random")
    save_split(tmp_path / "split.json", split, records)
    return tmp_path / "split.json", records, split


def move(saved: dict[str, Any]) -> None:
    saved["ids"]["train"].append(saved["ids"]["test"].pop())


def reorder(saved: dict[str, Any]) -> None:
    saved["ids"]["val"].reverse()


def rename(saved: dict[str, Any]) -> None:
    saved["ids"]["val"][0] = "another"


def rehash(saved: dict[str, Any]) -> None:
    saved["sha256"] = "0" * 64


@pytest.mark.parametrize("edit", [move, reorder, rename, rehash])
def test_an_edited_file(saved: tuple[Path, list[Record], Split], edit: Callable[[dict[str, Any]], None]) -> None:
    path, records, _ = saved
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))
    with pytest.raises(DataError) as caught:
        load_split(path, records)
    assert str(caught.value) == (
        f"'{path}': its ids do not have the hash it states; it was edited. Restore it, or train again."
    )


def test_lost_pairs(saved: tuple[Path, list[Record], Split]) -> None:
    path, records, split = saved
    gone = {split.train[3], split.test[0]}
    with pytest.raises(DataError) as caught:
        load_split(path, [record for i, record in enumerate(records) if i not in gone])
    assert str(caught.value) == (
        f"'{path}' names 2 pairs that this data set does not have, the first is '{records[split.train[3]].id}'. "
        "Pass the data= and data.root= it was trained on."
    )


def without(key: str) -> Callable[[dict[str, Any]], Any]:
    return lambda saved: {k: v for k, v in saved.items() if k != key}


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda _: [], "TypeError: list indices must be integers or slices, not str"),
        (without("ids"), "KeyError: 'ids'"),
        (without("seed"), "KeyError: 'seed'"),
        (lambda saved: {**saved, "ids": {"train": []}}, "KeyError: 'val'"),
        (lambda saved: {**saved, "fractions": 0.7}, "TypeError: 'float' object is not iterable"),
        (lambda saved: {**saved, "fractions": [1]}, "ValueError: not enough values to unpack (expected 3, got 1)"),
    ],
)
def test_a_file_that_is_no_split(saved: tuple[Path, list[Record], Split], damage: Any, reason: str) -> None:
    path, records, _ = saved
    path.write_text(json.dumps(damage(json.loads(path.read_text()))))
    with pytest.raises(DataError) as caught:
        load_split(path, records)
    assert str(caught.value) == f"'{path}' is not a split.json ({reason})."


@pytest.mark.parametrize("data", [b"", b"{", b"\xff\xfe\x00"])
def test_a_file_that_is_no_json(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "split.json"
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"split\.json' is not a split\.json \((JSON|Unicode)DecodeError: .*\)\.$"):
        load_split(path, [])


def test_no_file(tmp_path: Path) -> None:
    path = tmp_path / "split.json"
    with pytest.raises(DataError) as caught:
        load_split(path, [])
    assert str(caught.value) == (
        f"'{path}' is not a split.json (FileNotFoundError: [Errno 2] No such file or directory: '{path}')."
    )


@pytest.mark.parametrize(
    ("kind", "hint"), [("offical", " Did you mean 'official'?"), ("scenes", " Did you mean 'scene'?"), ("x", "")]
)
def test_unknown_kind(kind: str, hint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_split(frames([10]), kind=kind)
    assert str(caught.value) == f"data.split: no '{kind}'.{hint} Pass one of random, scene, official, test."


@pytest.mark.parametrize(
    "fractions", [[0.7, 0.3], [0.7, 0.1, 0.1], [0.7, 0.1, 0.3], [1.2, -0.1, -0.1], [0.7, float("nan"), 0.2], []]
)
def test_bad_fractions(fractions: list[float]) -> None:
    with pytest.raises(ConfigError) as caught:
        make_split(frames([10]), kind="random", fractions=fractions)
    assert str(caught.value) == (
        f"data.fractions: {fractions} are not three shares that sum to 1, as [0.7,0.1,0.2] do."
    )


@pytest.mark.parametrize(
    ("kind", "records", "fractions", "empty", "found"),
    [
        ("random", frames([3, 3]), PAPER, "val", "6 pairs, 2 scenes"),
        ("random", [], PAPER, "train", "0 pairs, 0 scenes"),
        ("random", frames([10]), (0.5, 0.5, 0.0), "test", "10 pairs, 1 scenes"),
        ("scene", frames([9]), PAPER, "val", "9 pairs, 1 scenes"),
        ("scene", frames([2, 2]), (0.5, 0.0, 0.5), "val", "4 pairs, 2 scenes"),
        ("official", frames([3, 3], split="train"), PAPER, "val", "6 pairs, 2 scenes"),
        ("official", frames([3, 3], split="train"), (0.5, 0.5, 0.0), "test", "6 pairs, 2 scenes"),
        ("official", [*frames([3], split="train"), *frames([3], split="test")], (0.0, 0.0, 1.0), "train",
         "6 pairs, 2 scenes"),
    ],
)  # fmt: skip
def test_a_subset_left_empty(
    kind: str, records: list[Record], fractions: tuple[float, float, float], empty: str, found: str
) -> None:
    with pytest.raises(DataError) as caught:
        make_split(records, kind=kind, fractions=fractions)
    assert str(caught.value) == (
        f"data.split={kind}: the {empty} subset is empty ({found}, fractions {list(fractions)}). "
        "Pass other data.fractions, another data.split, or more data."
    )


@pytest.mark.parametrize(("kind", "split"), [("scene", ""), ("official", "train")])
def test_pairs_without_a_scene(kind: str, split: str) -> None:
    records = [*frames([3] * 9, split=split), Record("a", "", 0, split), Record("b", "", 1, split)]
    with pytest.raises(DataError) as caught:
        make_split(records, kind=kind)
    assert str(caught.value) == (
        "data.split: 2 pairs name no scene, so scenes cannot be kept apart. "
        "Add a scene column to the manifest, or pass data.split=random."
    )
    assert len(make_split(records, kind="random").train) == 20


def test_no_official_split() -> None:
    records = [*frames([3] * 3, split="train"), *frames([4]), *frames([1], split="test")]
    with pytest.raises(DataError) as caught:
        make_split(records, kind="official")
    assert str(caught.value) == (
        "data.split=official: 4 of 14 pairs are in neither 'train' nor 'test' of the set's own split. "
        "Pass data.split=scene or data.split=random."
    )


@pytest.mark.parametrize(
    ("kind", "split", "fractions"),
    [("test", "", PAPER), ("official", "test", PAPER), ("random", "", (0, 0, 1)), ("scene", "", (0.0, 0.0, 1.0))],
)
def test_a_set_may_be_all_test(kind: str, split: str, fractions: tuple[float, float, float]) -> None:
    made = make_split(frames([2, 3], split=split), kind=kind, fractions=fractions)
    assert (made.train, made.val, sorted(made.test)) == ([], [], list(range(5)))


def test_a_sets_own_validation_pairs_are_used() -> None:
    records = [*frames([3], split="train"), *frames([2], split="val"), *frames([2], split="test")]
    made = make_split(records, kind="official")
    assert (made.train, made.val, made.test) == ([0, 1, 2], [3, 4], [5, 6])
