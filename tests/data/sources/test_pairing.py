"""Pairing by name."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import DataError
from hudepth.data.sources.pairing import natural_key, pair_up, unique_keys, walk_files


def test_numbers_sort_as_numbers() -> None:
    names = ["b", "a_10", "a_2", "a_02", "a", "10", "9"]
    assert sorted(names, key=natural_key) == ["9", "10", "a", "a_02", "a_2", "a_10", "b"]


@given(st.lists(st.text(max_size=6)))
def test_natural_order_is_total(names: list[str]) -> None:
    backwards = names[::-1]
    assert sorted(names, key=natural_key) == sorted(backwards, key=natural_key)


def test_pairs_come_in_natural_order() -> None:
    files = {name: f"{name}.png" for name in ("f10", "f9")}
    pairs = pair_up(files, files, root=Path("r"), expects="x")
    assert pairs == [("f9", "f9.png", "f9.png"), ("f10", "f10.png", "f10.png")]


@pytest.mark.parametrize(
    ("images", "depths", "message"),
    [
        ({}, {}, "data.root: no pairs in 'r'. Expected X."),
        (
            {"1": "i1", "10": "i10", "9": "i9"},
            {"1": "d1"},
            "data.root: 2 of 3 images in 'r' have no depth, the first is 'i9'. Expected X.",
        ),
        (
            {"1": "i1"},
            {"1": "d1", "2": "d2"},
            "data.root: 1 of 2 depth maps in 'r' have no image, the first is 'd2'. Expected X.",
        ),
    ],
)
def test_unpaired(images: dict[str, str], depths: dict[str, str], message: str) -> None:
    with pytest.raises(DataError) as caught:
        pair_up(images, depths, root=Path("r"), expects="X")
    assert str(caught.value) == message


def test_two_files_for_one_key() -> None:
    with pytest.raises(DataError) as caught:
        unique_keys([("1", "1.jpg"), ("1", "1.png")], what="image")
    assert str(caught.value) == "'1.jpg' and '1.png' are both the image of '1'. Keep one of them."


def test_walk_is_sorted_and_ignores_linked_folders(tmp_path: Path) -> None:
    for name in ("b/2", "b/1", "a/x/3", "0"):
        (tmp_path / "set" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "set" / name).touch()
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "4").touch()
    (tmp_path / "set" / "link").symlink_to(tmp_path / "secret")
    assert [str(path) for path in walk_files(tmp_path / "set")] == ["0", "a/x/3", "b/1", "b/2"]
