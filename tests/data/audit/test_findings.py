"""Findings on sets made to have them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hudepth.data.audit.duplicates import Duplicates
from hudepth.data.audit.findings import Finding, judge_depth, judge_split
from hudepth.data.audit.leakage import Leakage
from hudepth.data.audit.scan import sample_raw, scan_store
from hudepth.data.prepare import prepare
from hudepth.data.store import DepthStore
from tests.data.audit.test_scan import MadeUp

SCENE_SEEN = Leakage({"train": 7, "val": 1, "test": 2}, 0, 1.0, {1: 0.5, 2: 1.0, 5: 1.0}, 1.5)
APART = Leakage({"train": 7, "val": 1, "test": 2}, 0, 0.0, {1: 0.0, 2: 0.0, 5: 0.0}, math.nan)
UNNAMED = Leakage({"train": 7, "val": 1, "test": 2}, 2, math.nan, {1: math.nan, 2: math.nan, 5: math.nan}, math.nan)
NOBODY = np.zeros(2, np.int64)
COPIED = Duplicates(0.5, 0.5, NOBODY, NOBODY, NOBODY > 0)
UNLIKE = Duplicates(0.0, 0.0, NOBODY, NOBODY, NOBODY > 0)


@pytest.mark.parametrize(
    ("leak", "copies", "severity", "text"),
    [
        (SCENE_SEEN, None, "warning", "100.0% of test frames from scenes in training"),
        (SCENE_SEEN, UNLIKE, "warning", "near copies of 0.0% there"),
        (APART, COPIED, "note", "near copies of 50.0% there"),
        (APART, UNLIKE, "ok", "0.0% of test frames"),
        (APART, None, "ok", "0.0% of test frames"),
        (UNNAMED, UNLIKE, "note", "unknown"),
    ],
)
def test_what_is_said_of_a_split(leak: Leakage, copies: Duplicates | None, severity: str, text: str) -> None:
    found = judge_split("random", leak, copies)
    assert found.severity == severity
    assert text in found.found
    assert found.about == "split=random"


Judge = Callable[..., dict[str, Finding]]


@pytest.fixture
def judge(tmp_path: Path) -> Judge:
    """Return a function that gives a store of given depths its findings, by what they are about."""

    def run(
        *depths: NDArray[np.generic] | None, encoding: str = "auto", indoor: bool = True, max_depth_m: float = 10
    ) -> dict[str, Finding]:
        source = MadeUp(depths, encoding)
        source.indoor = indoor
        store: DepthStore = prepare(source, size=(16, 20), cache=tmp_path, on_error="skip", workers=1)
        scan, raw = scan_store(store), sample_raw(source, source.records())
        found = judge_depth(store, scan, raw, indoor=indoor, max_depth_m=max_depth_m)
        return {finding.about: finding for finding in found}

    return run


def plane(low_mm: int = 1000, high_mm: int = 9000, shape: tuple[int, int] = (16, 20)) -> NDArray[np.uint16]:
    return np.linspace(low_mm, high_mm, shape[0] * shape[1]).reshape(shape).astype(np.uint16)


def test_a_good_set_is_ok(judge: Judge) -> None:
    depth = plane()
    depth[0, :2] = 1000, 1001
    found = judge(depth)
    assert [finding.about for finding in found.values() if finding.severity != "ok"] == []
    assert found["depth and unit"].found == "1 to 9 m, median 5 m; encoding auto"
    assert len(found) == 9


def test_repeated_images_and_constant_depth_are_warned_of(judge: Judge) -> None:
    found = judge(plane(), plane(2000), np.full((16, 20), 4000, np.uint16))
    assert (found["repeated images"].severity, found["repeated images"].values) == ("warning", {"copies": 1})
    assert (found["constant depth"].severity, found["constant depth"].values) == ("warning", {"ids": ["p2"]})


def test_units_no_room_has_are_warned_of(judge: Judge) -> None:
    dark = (plane() // 40).astype(np.uint8)
    assert judge(dark, encoding="paper_literal")["depth and unit"].severity == "warning"
    assert judge(dark, encoding="uint8_10m")["depth and unit"].severity == "ok"
    assert judge(plane(20_000, 60_000), encoding="uint16_mm", indoor=False)["depth and unit"].severity == "ok"


def test_coarse_steps_are_noted(judge: Judge) -> None:
    step = judge((plane() // 40).astype(np.uint8))["step of depth"]
    assert step.severity == "note"
    assert step.found.startswith("39.2 mm")
    assert "off by up to 20 mm" in step.meaning
    assert judge(np.full((16, 20), 4000, np.uint16))["step of depth"].found == "none"


def test_holes_are_counted(judge: Judge) -> None:
    depth = plane()
    depth[:4] = 0
    holes = judge(depth)["holes"]
    assert (holes.severity, holes.found, holes.values) == ("note", "25.00% of pixels", {"share": 0.25})


def test_clipped_and_idle_ranges(judge: Judge) -> None:
    assert judge(plane(), max_depth_m=5)["clipping"].severity == "warning"
    assert judge(plane(), max_depth_m=5)["clipping"].values["share"] == pytest.approx(0.5)
    assert judge(plane(), max_depth_m=8.7)["clipping"].severity == "note"
    assert judge(plane(), max_depth_m=80)["clipping"].severity == "note"
    assert judge(plane(), max_depth_m=80)["clipping"].values["share"] == 0
    assert judge(plane(), max_depth_m=10)["clipping"].severity == "ok"


def test_depth_cut_off_is_noted(judge: Judge) -> None:
    found = judge(np.minimum(plane(), 6000))["saturation"]
    assert found.severity == "note"
    assert found.values["share"] == pytest.approx((plane() >= 6000).mean())


def test_sizes_that_differ_are_noted(judge: Judge) -> None:
    found = judge(plane(), plane(shape=(32, 40)))["native size"]
    assert (found.severity, found.found) == ("note", "20 x 16, 40 x 32")
    assert found.values == {"sizes": [[16, 20], [32, 40]]}


def test_skipped_pairs_are_warned_of(judge: Judge) -> None:
    found = judge(plane(), None, plane())["unreadable pairs"]
    assert (found.severity, found.found) == ("warning", "1, the first: 'p1': damaged.")
    assert found.values == {"skipped": ["'p1': damaged."]}
