"""Raw frames in one folder and in a folder per scene, and the real sample."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.encoding import to_metres
from hudepth.data.sources.base import Record
from hudepth.data.sources.nyu_raw import NyuRawSource
from hudepth.data.sources.plausible import check_range

RGB = np.full((6, 8, 3), 200, np.uint8)
DEPTH = np.arange(48, dtype=np.uint16).reshape(6, 8)
EXPECTED = "Expected rgb_XXXXX.jpg with sync_depth_XXXXX.png."
SKIP = "Pass data.on_error=skip to leave them out."


def write(folder: Path, *numbers: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        cv2.imwrite(str(folder / f"rgb_{number}.jpg"), RGB)
        cv2.imwrite(str(folder / f"sync_depth_{number}.png"), DEPTH)


def refusal(source: NyuRawSource) -> str:
    with pytest.raises(DataError) as caught:
        source.records()
    return str(caught.value)


def test_frames_in_the_root(tmp_path: Path) -> None:
    root = tmp_path / "basement_0001a"
    write(root, "00010", "00002")
    assert NyuRawSource(root).records() == [
        Record(
            id=f"basement_0001a/{number}",
            scene="basement_0001a",
            frame=int(number),
            category="basement",
            image=f"rgb_{number}.jpg",
            depth=f"sync_depth_{number}.png",
        )
        for number in ("00002", "00010")
    ]


def test_a_folder_per_scene(tmp_path: Path) -> None:
    write(tmp_path / "sync/office_0003", "00000")
    write(tmp_path / "bath_0001", "00000")
    (tmp_path / "bath_0001/readme.txt").touch()
    assert NyuRawSource(tmp_path).records() == [
        Record(
            id=f"{scene}/00000",
            scene=scene,
            frame=0,
            category=category,
            image=f"{scene}/rgb_00000.jpg",
            depth=f"{scene}/sync_depth_00000.png",
        )
        for scene, category in (("bath_0001", "bath"), ("sync/office_0003", "office"))
    ]


def test_reads_a_pair(tmp_path: Path) -> None:
    write(tmp_path / "a", "00000")
    source = pickle.loads(pickle.dumps(NyuRawSource(tmp_path)))
    pair = source.read(source.records()[0])
    assert np.abs(pair.image.astype(int) - RGB).max() <= 2
    np.testing.assert_array_equal(pair.depth, DEPTH)
    assert source.files() == [tmp_path / "a/rgb_00000.jpg", tmp_path / "a/sync_depth_00000.png"]


def test_refusals(tmp_path: Path) -> None:
    do = "Pass data.root=<folder with rgb_XXXXX.jpg with sync_depth_XXXXX.png>, or run with data=rooms."
    assert refusal(NyuRawSource(None)) == f"data.root is not set. {do}"
    assert refusal(NyuRawSource(tmp_path)) == f"data.root: no pairs in '{tmp_path}'. {EXPECTED}"
    write(tmp_path / "a", "00000", "00001", "00002")
    (tmp_path / "a/sync_depth_00001.png").unlink()
    (tmp_path / "a/sync_depth_00002.png").unlink()
    assert refusal(NyuRawSource(tmp_path)) == (
        f"data.root: 2 of 3 images in '{tmp_path}' have no depth, the first is 'a/rgb_00001.jpg'. {EXPECTED} {SKIP}"
    )
    (tmp_path / "a/rgb_00001.jpg").unlink()
    (tmp_path / "a/rgb_00002.jpg").unlink()
    write(tmp_path / "b", "00005")
    (tmp_path / "b/rgb_00005.jpg").unlink()
    assert refusal(NyuRawSource(tmp_path)) == (
        f"data.root: 1 of 2 depth maps in '{tmp_path}' have no image, the first is 'b/sync_depth_00005.png'. "
        f"{EXPECTED} {SKIP}"
    )
    (tmp_path / "a/rgb_00000.png").touch()
    assert refusal(NyuRawSource(tmp_path)) == (
        "'a/rgb_00000.jpg' and 'a/rgb_00000.png' are both the image of 'a/00000'. Keep one of them."
    )
    with pytest.raises(ConfigError, match=r"data\.encoding: 'metre'"):
        NyuRawSource(tmp_path, encoding="metre").records()


def test_truncated_frame(tmp_path: Path) -> None:
    write(tmp_path, "00000")
    path = tmp_path / "rgb_00000.jpg"
    path.write_bytes(path.read_bytes()[:-10])
    source = NyuRawSource(tmp_path)
    with pytest.raises(DataError, match=r"rgb_00000\.jpg': the JPEG is truncated"):
        source.read(source.records()[0])


def test_real_frames(nyu_root: Path) -> None:
    sample = nyu_root.parent / "nyu_raw_sample"
    if not sample.is_dir():
        pytest.skip(f"no raw NYU frames in '{sample}'")
    source = NyuRawSource(sample)
    records = source.records()
    assert [record.frame for record in records] == [0, 50, 100]
    pairs = [source.read(record) for record in records]
    assert {pair.image.shape for pair in pairs} == {(480, 640, 3)}
    depths = [to_metres(pair.depth, source.encoding) for pair in pairs]
    for pair, depth in zip(pairs, depths, strict=True):
        assert pair.depth.dtype == np.uint16
        np.testing.assert_array_equal((depth * 1000).round().astype(np.uint16), pair.depth)
    found = check_range(depths, indoor=True, encoding=source.encoding, name=source.name)
    assert 0.3 < found.min_m < found.median_m < found.max_m < 10.5
    assert 0.5 < found.valid_fraction < 1.0  # real holes
