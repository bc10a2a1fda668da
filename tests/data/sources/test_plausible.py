"""Ranges of rooms, and encodings that would explain others."""

from __future__ import annotations

import numpy as np
import pytest

from hudepth.base.errors import DataError
from hudepth.data.encoding import to_metres
from hudepth.data.sources.plausible import DepthRange, check_range, looks_swapped, suggest

SURFACE = 1000 + np.add.outer(40 * np.arange(48), 20 * np.arange(64)).astype(np.float64)  # millimetres, median 2.6 m


@pytest.mark.parametrize(
    ("raw", "meant"),
    [
        (np.rint(SURFACE * 5).astype(np.uint16), "uint16_5000"),
        (np.rint(SURFACE * 4).astype(np.uint16), "uint16_4000"),
        (np.rint(SURFACE * 0.256).astype(np.uint16), "uint16_256"),
        (np.rint(SURFACE).astype(np.uint16) << 3, "sunrgbd"),
        (np.rint(SURFACE / 10).astype(np.uint16), "cm"),
        (SURFACE.astype(np.float32), "mm"),
        ((SURFACE / 10).astype(np.float32), "cm"),
        (np.rint(SURFACE * 0.0255).astype(np.uint8), "uint8_10m"),
    ],
)
def test_a_plausible_encoding_is_named(raw: np.ndarray, meant: str) -> None:
    assert f"data.encoding={meant} (median 2.6 m)" in suggest([raw])


def test_auto_does_not_guess_a_unit() -> None:
    for value, indoor in ((16_000, True), (640, True), (3000, False)):
        raw = np.full((4, 4), value, np.uint16)
        with pytest.raises(DataError, match=r"data\.encoding=auto: .*KITTI.*data.encoding=uint16_"):
            check_range([to_metres(raw, "auto")], indoor=indoor, encoding="auto", name="x", raws=[raw])


def test_auto_does_not_take_wide_images_for_rooms() -> None:
    raw = np.tile(np.uint16([2000, 4000]), (8, 16))  # as near as KITTI may be: 4 m and 8 m, 7.8 m and 15.6 m in truth
    with pytest.raises(DataError, match=r"data\.encoding=auto: .*KITTI"):
        check_range([to_metres(raw, "auto")], indoor=True, encoding="auto", name="x", raws=[raw])
    assert check_range([to_metres(raw.T, "auto")], indoor=True, encoding="auto", name="x", raws=[raw.T]).max_m == 4


def test_auto_does_not_take_inverse_depth_for_metres() -> None:
    raw = (1000 / SURFACE).astype(np.float32)
    with pytest.raises(DataError, match=r"data\.encoding=auto: .*disparity"):
        check_range([raw], indoor=True, encoding="auto", name="x", raws=[raw])


def test_swapped_bytes_are_seen() -> None:
    raw = np.rint(SURFACE).astype(np.uint16)
    assert looks_swapped(raw.byteswap())
    assert not looks_swapped(raw)
    assert not looks_swapped((raw >> 5) << 8)  # 8 bits kept in the upper ones
    assert not looks_swapped(np.random.default_rng(0).integers(0, 65536, (48, 64), np.uint16))


def test_range_is_of_the_measured_pixels() -> None:
    depths = [np.array([[0, 1, 2]], np.float32), np.array([[0], [4], [9], [8]], np.float32)]
    found = check_range(depths, indoor=True, encoding="float_m", name="folder")
    assert found == DepthRange(min_m=1.0, median_m=4.0, max_m=9.0, valid_fraction=5 / 7)


@pytest.mark.parametrize(("depth_m", "shown"), [(0.255, "0.255"), (2500.0, "2.5e+03"), (0.29, "0.29")])
def test_range_refuses_an_implausible_room(depth_m: float, shown: str) -> None:
    depths = [np.full((2, 2), depth_m, np.float32)]
    with pytest.raises(DataError) as caught:
        check_range(depths, indoor=True, encoding="uint16_mm", name="folder")
    start = f"data.encoding=uint16_mm: 'folder' has a median depth of {shown} m, indoor sets lie in 0.3 to 20 m. Pass "
    assert str(caught.value).startswith(start)
    assert str(caught.value).endswith("or data.source.indoor=false for outdoor pairs.")
    assert check_range(depths, indoor=False, encoding="uint16_mm", name="folder").median_m == np.float32(depth_m)


def test_range_lets_the_paper_through() -> None:
    depths = [np.full((2, 2), 0.1, np.float32)]
    assert check_range(depths, indoor=True, encoding="paper_literal", name="x").median_m == np.float32(0.1)


@pytest.mark.parametrize("depths", [[], [np.zeros((2, 2), np.float32)]])
def test_range_refuses_depth_without_measurement(depths: list[np.ndarray]) -> None:
    with pytest.raises(DataError) as caught:
        check_range(depths, indoor=False, encoding="paper_literal", name="folder")
    start = f"data.encoding=paper_literal: no pixel of 'folder' is measured in {len(depths)} depth maps. "
    assert str(caught.value).startswith(start)
