"""The official split of NYU Depth V2."""

from __future__ import annotations

from pathlib import Path

import pytest

from hudepth.data.sources.manifest import NyuLabeledSource
from hudepth.data.sources.nyu import COUNT, category_of, official_test


def test_the_official_test_set() -> None:
    test = official_test()
    assert len(test) == 654
    assert COUNT - len(test) == 795
    assert min(test) == 0
    assert max(test) < COUNT


def test_it_is_that_of_splits_mat(nyu_root: Path) -> None:
    path = nyu_root / "splits.mat"
    if not path.exists():
        pytest.skip("no splits.mat")
    splits = pytest.importorskip("scipy.io").loadmat(path)
    assert {number - 1 for number in splits["testNdxs"].ravel().tolist()} == official_test()


def test_it_is_that_of_the_labelled_set(nyu_root: Path) -> None:
    records = NyuLabeledSource(nyu_root).records()
    assert {index for index, record in enumerate(records) if record.split == "test"} == official_test()


@pytest.mark.parametrize(
    ("scene", "category"),
    [("kitchen_0004", "kitchen"), ("sync/study_room_0005b", "study_room"), ("office", "office"), ("", "")],
)
def test_category(scene: str, category: str) -> None:
    assert category_of(scene) == category
