"""One pair decoded, checked and resized, against numpy; and many of them, in order, in one process or several."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.pairs import (
    POOL_FROM,
    PreparedPair,
    nearest_measured,
    prepare_pair,
    prepare_pairs,
    read_metres,
    values_per_metre,
)
from hudepth.data.sources.base import RawPair, Record, Source
from hudepth.data.sources.folder import FolderSource


class MemorySource(Source):
    """Pairs that are already decoded."""

    name = "memory"

    def __init__(self, pairs: list[RawPair], *, encoding: str = "float_m", **options: Any) -> None:
        self.pairs, self.encoding, self.options = pairs, encoding, options

    def records(self) -> list[Record]:
        return [Record(id=str(i), scene="", frame=i, **self.options) for i in range(len(self.pairs))]

    def read(self, record: Record) -> RawPair:
        return self.pairs[record.frame]


def random_pair(height: int, width: int, *, seed: int = 0) -> RawPair:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 9.5, (height, width)).astype(np.float32)
    depth[rng.random((height, width)) < 0.2] = 0
    depth[0, 0] = 2
    return RawPair(rng.integers(0, 256, (height, width, 3), np.uint8), depth)


def prepare_one(pair: RawPair, size: tuple[int, int], *, native: bool = True) -> PreparedPair:
    source = MemorySource([pair])
    return prepare_pair(source, source.records()[0], size, native=native)


def nearest(n_out: int, n_in: int) -> tuple[np.ndarray, np.ndarray]:
    """The input pixel in which each output pixel's centre lies, and whether it lies in one, not between two."""
    twice_centre = (2 * np.arange(n_out) + 1) * n_in
    return twice_centre // (2 * n_out), twice_centre % (2 * n_out) != 0


@given(height=st.integers(2, 30), width=st.integers(2, 30), h=st.integers(1, 30), w=st.integers(1, 30))
def test_depth_takes_the_nearest_pixel(height: int, width: int, h: int, w: int) -> None:
    pair = random_pair(height, width)
    (rows, row_is_clear), (columns, column_is_clear) = nearest(h, height), nearest(w, width)
    found = prepare_one(pair, (h, w)).stored_depth
    assert (found.dtype, found.shape) == (np.uint16, (h, w))
    mm = np.rint(pair.depth * 1000)
    assert set(found.ravel()) <= set(mm.ravel())  # no mean of two surfaces
    clear = np.ix_(row_is_clear, column_is_clear)
    np.testing.assert_array_equal(found[clear], mm[rows][:, columns][clear])


def test_images_shrink_to_the_mean_of_what_each_pixel_covers() -> None:
    pair = random_pair(24, 36)
    expected = pair.image.reshape(8, 3, 12, 3, 3).mean(axis=(1, 3))
    found = prepare_one(pair, (8, 12)).image
    assert found.dtype == np.uint8
    assert np.abs(found - expected).max() <= 0.5


@pytest.mark.parametrize("size", [(48, 64), (24, 33), (20, 40)])
def test_images_grow_bilinearly(size: tuple[int, int]) -> None:
    pair = random_pair(24, 32)
    expected = cv2.resize(pair.image, size[::-1], interpolation=cv2.INTER_LINEAR)
    np.testing.assert_array_equal(prepare_one(pair, size).image, expected)


def test_equal_size_changes_nothing() -> None:
    pair = random_pair(24, 32)
    prepared = prepare_one(pair, (24, 32))
    np.testing.assert_array_equal(prepared.image, pair.image)
    np.testing.assert_array_equal(prepared.stored_depth, np.rint(pair.depth * 1000))


def test_native_truth_and_figures() -> None:
    pair = random_pair(10, 13)
    prepared = prepare_one(pair, (4, 4))
    assert prepared.native_png is not None
    mm = cv2.imdecode(prepared.native_png, cv2.IMREAD_UNCHANGED)
    assert mm.dtype == np.uint16
    np.testing.assert_array_equal(mm, np.rint(pair.depth * 1000))
    measured = pair.depth[pair.depth > 0]
    assert prepared.range_m == pytest.approx((measured.min(), np.median(measured), measured.max()))
    assert prepared.valid_fraction == pytest.approx(len(measured) / 130)
    assert prepared.native_size == (10, 13)
    assert prepare_one(pair, (4, 4), native=False).native_png is None


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize(("depth", "name"), [("", "0"), ("depths/a.png", "depths/a.png")])
def test_nothing_measured(value: float, depth: str, name: str) -> None:
    pair = RawPair(np.zeros((4, 4, 3), np.uint8), np.full((4, 4), value, np.float32))
    source = MemorySource([pair], depth=depth)
    with pytest.raises(DataError) as caught:
        prepare_pair(source, source.records()[0], (2, 2), native=True)
    assert str(caught.value).startswith(f"'{name}': ")
    assert "nothing is measured" in str(caught.value)
    assert ("sign" in str(caught.value)) == (value < 0)


@pytest.mark.parametrize(
    ("indoor", "largest", "fix"),
    [(True, 65.6, "indoor=false"), (True, 300, "farthest_m=300"), (False, 256.5, "farthest_m=257")],
)
def test_what_a_store_cannot_hold_is_refused(indoor: bool, largest: float, fix: str) -> None:
    depth = np.full((4, 4), 2.0, np.float32)
    depth[0, 0] = largest
    source = MemorySource([RawPair(np.zeros((4, 4, 3), np.uint8), depth)])
    source.indoor = indoor
    with pytest.raises(DataError, match=rf"'0': .*{largest:g} m.*{fix}"):
        prepare_pair(source, source.records()[0], (2, 2), native=True)


@pytest.mark.parametrize(
    ("indoor", "farthest_m", "per_m"),
    [(True, None, 1000), (True, 65.535, 1000), (True, 66, 256), (False, None, 256), (False, 50, 256),
     (False, 255.9, 256), (False, 256, 128), (False, 350, 128), (False, 600, 64), (False, 65_535, 1)],
)  # fmt: skip
def test_steps_are_as_fine_as_the_farthest_depth_allows(indoor: bool, farthest_m: float | None, per_m: int) -> None:
    depth = np.full((4, 4), 2.0, np.float32)
    depth[1, 1] = 80.0 if farthest_m is None else farthest_m
    source = MemorySource([RawPair(np.zeros((4, 4, 3), np.uint8), depth)])
    source.indoor, source.farthest_m = indoor, farthest_m
    if indoor and farthest_m is None:
        depth[1, 1] = 65.535
    assert values_per_metre(source) == per_m
    prepared = prepare_pair(source, source.records()[0], (4, 4), native=True)
    assert prepared.native_png is not None
    native = cv2.imdecode(prepared.native_png, cv2.IMREAD_UNCHANGED)
    for stored in (prepared.stored_depth, native):
        assert abs(stored[1, 1] / per_m - depth[1, 1]) <= 0.5 / per_m
        assert stored[0, 0] == 2 * per_m


@given(st.integers(1, 12), st.integers(1, 12), st.integers(1, 12), st.integers(1, 12), st.integers(0, 9))
def test_sparse_depth_takes_the_nearest_measured_pixel(
    rows: int, columns: int, height: int, width: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((rows, columns)) < 0.3, rng.uniform(1, 80, (rows, columns)), 0).astype(np.float32)
    found = nearest_measured(depth, (height, width))
    for i in range(height):
        for j in range(width):
            # exact: centres in units of 1 / (2 rows) and 1 / (2 columns) of the result's pixels
            inside = {
                (y, x): (Fraction((2 * y + 1) * height, 2 * rows) - i - Fraction(1, 2)) ** 2
                + (Fraction((2 * x + 1) * width, 2 * columns) - j - Fraction(1, 2)) ** 2
                for y, x in zip(*(each.tolist() for each in np.nonzero(depth)), strict=True)
                if (2 * y + 1) * height // (2 * rows) == i and (2 * x + 1) * width // (2 * columns) == j
            }
            nearest_ones = {depth[at] for at, off in inside.items() if off <= min(inside.values()) + Fraction(1, 10**9)}
            assert found[i, j] in (nearest_ones or {0})


def test_sparse_depth_survives_shrinking() -> None:
    """As at KITTI's training sizes: most points lie beside the pixels that nearest resizing takes."""
    depth = np.zeros((375, 1242), np.float32)
    depth[150::5, ::7] = 80.0
    source = MemorySource([RawPair(np.zeros((375, 1242, 3), np.uint8), depth)])
    source.indoor = False
    shares = []
    for source.sparse in (False, True):
        prepared = prepare_pair(source, source.records()[0], (96, 320), native=True)
        shares.append(np.mean(prepared.stored_depth > 0))
        assert set(np.unique(prepared.stored_depth)) == {0, 80 * 256}
    assert shares[1] > 10 * shares[0]


def test_the_records_scale_and_offset_are_applied() -> None:
    source = MemorySource([], encoding="linear")
    record = Record("a", "", 0, depth_scale_m=0.02, depth_offset=10)
    found = read_metres(source, record, np.array([[0, 90]], np.uint8))
    np.testing.assert_array_equal(found, np.array([[0.2, 2.0]], np.float32))


def test_a_wrong_encoding_names_the_file() -> None:
    source = MemorySource([], encoding="uint16_mm")
    with pytest.raises(DataError, match=r"^depths/a\.png: 8-bit data declared as millimetres \(largest value 7 "):
        read_metres(source, Record("a", "", 0, depth="depths/a.png"), np.array([[7]], np.uint8))


def test_each_bad_pair_is_a_line_in_its_place() -> None:
    bad = RawPair(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32))
    source = MemorySource([random_pair(4, 4, seed=0), bad, random_pair(4, 4, seed=2)])
    outcomes = list(prepare_pairs(source, source.records(), (2, 2), native=False, workers=1))
    assert [record.id for record, _ in outcomes] == ["0", "1", "2"]
    assert [outcome if isinstance(outcome, str) else "" for _, outcome in outcomes] == [
        "", "'1': the depth is zero everywhere, nothing is measured.", "",
    ]  # fmt: skip


def test_a_mistaken_configuration_is_no_bad_pair() -> None:
    source = MemorySource([random_pair(4, 4)], encoding="milimetres")
    with pytest.raises(ConfigError, match=r"data.encoding: 'milimetres'"):
        list(prepare_pairs(source, source.records(), (2, 2), native=False, workers=1))


def test_several_workers_yield_the_same_in_order(tmp_path: Path) -> None:
    n = POOL_FROM + 3
    for name in ("images", "depths"):
        (tmp_path / name).mkdir()
    for i in range(n):
        pair = random_pair(6, 8, seed=i)
        cv2.imwrite(str(tmp_path / f"images/{i}.png"), pair.image)
        depth = pair.depth if i != 30 else np.zeros_like(pair.depth)
        cv2.imwrite(str(tmp_path / f"depths/{i}.png"), np.rint(depth * 1000).astype(np.uint16))
    source = FolderSource(tmp_path, encoding="uint16_mm")
    one, two = (list(prepare_pairs(source, source.records(), (3, 4), native=True, workers=w)) for w in (1, 2))
    assert [record.id for record, _ in two] == [str(i) for i in range(n)]
    for (_, a), (record, b) in zip(one, two, strict=True):
        if isinstance(a, str):
            assert a == b == f"'{record.depth}': the depth is zero everywhere, nothing is measured."
            continue
        assert isinstance(b, PreparedPair)
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.stored_depth, b.stored_depth)
        np.testing.assert_array_equal(a.native_png, b.native_png)
        assert (a.native_size, a.range_m, a.valid_fraction) == (b.native_size, b.range_m, b.valid_fraction)


class DeadlySource(MemorySource):
    """Kills the process it is handed to, as a system short of memory does."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (1,)


def test_a_killed_worker_gives_one_line() -> None:
    source = DeadlySource([random_pair(4, 4)] * POOL_FROM)
    with pytest.raises(DataError) as caught:
        list(prepare_pairs(source, source.records(), (2, 2), native=False, workers=2))
    assert str(caught.value) == (
        "memory: a preparing process was killed (out of memory?). Pass data.prepare_workers=1."
    )
