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
    assert str(caught.value).startswith(message)


def test_two_files_for_one_key() -> None:
    with pytest.raises(DataError) as caught:
        unique_keys([("1", "1.jpg"), ("1", "1.png")], what="image")
    assert str(caught.value) == "'1.jpg' and '1.png' are both the image of '1'. Keep one of them."


def test_walk_is_sorted_and_follows_links_once(tmp_path: Path) -> None:
    for name in ("set/b/2", "set/b/1", "set/a/x/3", "set/0", "set/._0", "beside/4"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "set/kitchen").symlink_to(tmp_path / "beside")
    (tmp_path / "beside/circle").symlink_to(tmp_path / "set")
    assert [str(path) for path in walk_files(tmp_path / "set")] == ["0", "a/x/3", "b/1", "b/2", "kitchen/4"]


def test_files_without_partner_can_be_left_out() -> None:
    images, depths = {"1": "1.jpg", "2": "2.jpg"}, {"2": "2.png", "3": "3.png"}
    unpaired: list[str] = []
    assert pair_up(images, depths, root=Path("r"), expects="x", unpaired=unpaired) == [("2", "2.jpg", "2.png")]
    assert unpaired == ["'1.jpg': has no depth.", "'3.png': has no image."]
    with pytest.raises(DataError, match=r"data\.on_error=skip"):
        pair_up(images, depths, root=Path("r"), expects="x")
    with pytest.raises(DataError, match="no depth"):
        pair_up(images, {}, root=Path("r"), expects="x", unpaired=[])
