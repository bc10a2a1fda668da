"""One pass over a store, and samples of raw depth, compared with plain counts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.data.audit.duplicates import digest_pixels, hash_images
from hudepth.data.audit.scan import sample_raw, scan_store
from hudepth.data.prepare import prepare
from hudepth.data.sources.base import RawPair, Record, Source


class MadeUp(Source):
    """Pairs given as arrays; None cannot be read."""

    name: ClassVar[str] = "made_up"
    auto_uint8: ClassVar[str | None] = "uint8_10m"

    def __init__(self, depths: Sequence[NDArray[np.generic] | None], encoding: str = "auto") -> None:
        self.depths, self.encoding = depths, encoding

    def records(self) -> Sequence[Record]:
        return [Record(id=f"p{i}", scene="a", frame=i) for i in range(len(self.depths))]

    def read(self, record: Record) -> RawPair:
        depth = self.depths[record.frame]
        if depth is None:
            raise DataError(f"'{record.id}': damaged.")
        shade = np.full((*depth.shape, 3), 20 * (record.frame // 2 % 12), np.uint8)  # two images of each shade
        return RawPair(shade, depth)


def test_a_store_is_scanned_in_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hudepth.data.audit.scan.CHUNK", 2)
    rng = np.random.default_rng(0)
    depths = [rng.integers(1000, 5000, (8, 10)).astype(np.uint16) for _ in range(5)]
    depths[1][:4] = 0
    depths[3][:] = 2500
    depths[4][:], depths[4][0, 0] = 3000, 0  # a hole is no second depth
    store = prepare(MadeUp(depths), size=(8, 10), cache=tmp_path, workers=1)
    scan = scan_store(store)
    images, stored = store.read(range(5))
    assert scan.hashes.tolist() == hash_images(images).tolist()
    assert scan.digests == digest_pixels(images)
    assert scan.histogram.tolist() == [int((stored == mm).sum()) for mm in range(1 << 16)]
    assert scan.constant == [3, 4]


def test_the_step_of_8_bits_is_39_mm() -> None:
    ramp = np.arange(256, dtype=np.uint8).reshape(16, 16)
    found = sample_raw(source := MadeUp([ramp] * 3), source.records())
    assert found.step_mm == pytest.approx(10_000 / 255, rel=1e-3)
    assert found.levels == 255  # 0 is unmeasured
    assert found.at_largest == pytest.approx(1 / 255)


def test_the_raw_sample_is_a_median_over_readable_pairs() -> None:
    depths = [np.array([[1000, 1000 + step, 9000]], np.uint16) for step in (5, 7, 100)]
    source = MadeUp(
        [None, depths[0], np.full((1, 3), 9000, np.uint16), depths[1], np.zeros((1, 3), np.uint16), depths[2]]
    )
    found = sample_raw(source, source.records())
    assert found.step_mm == pytest.approx(7, rel=1e-4)
    assert found.levels == 3
    assert found.at_largest == pytest.approx((3 + 3) / 12)


def test_a_sample_is_spread_over_the_set() -> None:
    source = MadeUp([np.array([[i + 1, 2 * i + 2]], np.uint16) for i in range(100)])
    read: list[int] = []

    def listen(record: Record) -> RawPair:
        read.append(record.frame)
        return MadeUp.read(source, record)

    source.read = listen  # type: ignore[method-assign]
    sample_raw(source, source.records(), pairs=10)
    assert read == list(range(0, 100, 10))


def test_nothing_readable_gives_nan() -> None:
    found = sample_raw(source := MadeUp([None]), source.records())
    assert math.isnan(found.step_mm)
    assert math.isnan(found.at_largest)
    assert found.levels == 0
