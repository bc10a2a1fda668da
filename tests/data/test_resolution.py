"""Progressive resolution: which size an epoch trains at, and which plans make no sense."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import ConfigError
from hudepth.data.resolution import Stage, read_stages, size_at

SIZE = (224, 288)
TWO = [Stage((112, 112), 0.5), Stage((160, 160), 0.8)]


def test_stages_are_read_in_order() -> None:
    plan: list[Mapping[str, Any]] = [{"size": [112, 144], "until": 0.5}, {"size": (160, 288), "until": 0.8}]
    assert read_stages(plan, size=SIZE) == [Stage((112, 144), 0.5), Stage((160, 288), 0.8)]
    assert read_stages([], size=SIZE) == []


@pytest.mark.parametrize(
    ("epochs", "sizes"),
    [
        (10, [112] * 5 + [160] * 3 + [224] * 2),
        (4, [112] * 2 + [160] + [224]),  # 0.8 of 4 epochs is 3, rounded
        (3, [112] * 2 + [224]),  # both stages round to 2 epochs
        (2, [112, 224]),
        (1, [224]),  # the last epoch is always at full size
    ],
)
def test_a_plan_by_hand(epochs: int, sizes: list[int]) -> None:
    assert [size_at(TWO, epoch, epochs=epochs, final=(224, 224))[0] for epoch in range(epochs)] == sizes


@pytest.mark.parametrize("epochs", [None, -1, 0])
def test_an_endless_training_has_one_size(epochs: int | None) -> None:
    assert {size_at(TWO, epoch, epochs=epochs, final=SIZE) for epoch in range(100)} == {SIZE}


def test_without_stages_every_epoch_has_the_stores_size() -> None:
    assert {size_at([], epoch, epochs=5, final=SIZE) for epoch in range(7)} == {SIZE}


@given(shares=st.lists(st.floats(0.01, 0.99), unique=True, max_size=4), epochs=st.integers(1, 200))
def test_sizes_follow_each_other_and_each_lasts_its_share(shares: list[float], epochs: int) -> None:
    stages = [Stage((16 + i, 16), share) for i, share in enumerate(sorted(shares))]
    sizes = [size_at(stages, epoch, epochs=epochs, final=(99, 16))[0] for epoch in range(epochs)]
    assert sizes == sorted(sizes)
    assert sizes[-1] == 99
    for stage in stages:
        over = sum(size <= stage.size[0] for size in sizes)
        assert abs(over - min(stage.until * epochs, epochs - 1)) <= 0.5 + 1e-9
    assert size_at(stages, epochs, epochs=epochs, final=(99, 16)) == (99, 16)  # what comes after the training


@given(shares=st.lists(st.floats(0.01, 0.99), unique=True, min_size=1, max_size=4))
def test_only_rising_shares_are_read(shares: list[float]) -> None:
    plan: list[Mapping[str, Any]] = [{"size": [112, 112], "until": share} for share in shares]
    if all(a < b for a, b in itertools.pairwise(shares)):
        assert [stage.until for stage in read_stages(plan, size=SIZE)] == shares
    else:
        with pytest.raises(ConfigError, match=r"data\.progressive\[\d\]\.until"):
            read_stages(plan, size=SIZE)


@pytest.mark.parametrize(
    "entry",
    [
        {},
        {"size": [112, 112]},
        {"until": 0.5},
        {"size": [112], "until": 0.5},
        {"size": [112, 112, 3], "until": 0.5},
        {"size": ["small", 112], "until": 0.5},
        {"size": [112, None], "until": 0.5},
        {"size": [112, 112], "until": "half"},
        {"size": [112, 112], "until": None},
        {"size": [math.nan, 112], "until": 0.5},
    ],
)
def test_malformed_stages_are_refused(entry: Mapping[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"^data\.progressive\.(size|until)"):
        read_stages([{"size": [64, 64], "until": 0.1}, entry], size=SIZE)


def test_one_number_makes_a_square() -> None:
    assert read_stages([{"size": 112, "until": 0.5}], size=SIZE) == [Stage((112, 112), 0.5)]


@pytest.mark.parametrize(
    ("before", "until"), [([], 0.0), ([], 1.0), ([], -0.5), ([], 2), ([], math.nan), ([0.5], 0.5), ([0.2, 0.6], 0.4)]
)
def test_a_share_out_of_order(before: list[float], until: float) -> None:
    plan: list[Mapping[str, Any]] = [{"size": [112, 112], "until": share} for share in (*before, until)]
    with pytest.raises(ConfigError, match=r"data\.progressive.*until"):
        read_stages(plan, size=SIZE)


@pytest.mark.parametrize("size", [SIZE, (240, 320), (208, 304), (240, 16)])
def test_a_stage_that_is_not_smaller_is_left_out(size: tuple[int, int]) -> None:
    plan = [{"size": [112, 144], "until": 0.3}, {"size": size, "until": 0.6}]
    assert read_stages(plan, size=SIZE) == [Stage((112, 144), 0.3)]
    with pytest.raises(ConfigError, match=r"\[2\]\.until: 0\.5"):
        read_stages([*plan, {"size": [128, 160], "until": 0.5}], size=SIZE)


@pytest.mark.parametrize("size", [[0, 112], [112, -16]])
def test_a_size_that_is_none(size: list[int]) -> None:
    with pytest.raises(ConfigError, match=r"data\.progressive.*size"):
        read_stages([{"size": size, "until": 0.5}], size=SIZE)
