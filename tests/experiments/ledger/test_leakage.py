from __future__ import annotations

import pytest

from experiments.ledger.leakage import consecutive_records, expected_share, share_next_to_training, split_frames

FRACTIONS = (0.7, 0.1, 0.2)


def test_records_are_named_in_video_order() -> None:
    records = consecutive_records(5, frames_per_scene=2)
    assert [(r.scene, r.frame) for r in records] == [("0000", 0), ("0000", 1), ("0001", 0), ("0001", 1), ("0002", 0)]
    assert len({r.id for r in records}) == 5


def test_expected_shares() -> None:
    assert expected_share(0.7, within=1) == pytest.approx(0.91)  # 1 - 0.3^2
    assert expected_share(0.7, within=2) == pytest.approx(0.9919)  # 1 - 0.3^4


@pytest.mark.parametrize("within", [1, 2, 3])
@pytest.mark.parametrize("length", [None, 7])
def test_shares_agree_with_a_loop(within: int, length: int | None) -> None:
    n = 60
    split = split_frames(n, kind="random", fractions=FRACTIONS, seed=3, frames_per_scene=length)
    train = set(split.train)
    adjacent = 0
    for test in split.test:
        near = [
            j
            for j in range(n)
            if j != test and abs(j - test) <= within and (not length or j // length == test // length)
        ]
        adjacent += any(j in train for j in near)
    assert share_next_to_training(split, n=n, within=within, frames_per_scene=length) == adjacent / len(split.test)


def test_counted_shares_are_near_the_expected() -> None:
    split = split_frames(20_000, kind="random", fractions=FRACTIONS, seed=42)
    for within in (1, 2):
        counted = share_next_to_training(split, n=20_000, within=within)
        assert counted == pytest.approx(expected_share(0.7, within=within), abs=0.015)


def test_a_split_by_scene_leaks_nothing() -> None:
    split = split_frames(200, kind="scene", fractions=FRACTIONS, seed=0, frames_per_scene=10)
    assert share_next_to_training(split, n=200, within=2, frames_per_scene=10) == 0
