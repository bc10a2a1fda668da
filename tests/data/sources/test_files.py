"""Decoding, the paths it may touch, and what it refuses."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hudepth.base.errors import DataError
from hudepth.data.sources.files import PerProcess, csv_rows, inside, make_pair
from hudepth.data.sources.folder import FolderSource
from hudepth.data.sources.manifest import ManifestSource
from hudepth.data.sources.sets.kitti import KittiSource

RGB = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).integers(0, 9999, (12, 20), dtype=np.uint16)


def message(error: pytest.ExceptionInfo[DataError]) -> str:
    return str(error.value)


def test_unequal_sizes() -> None:
    with pytest.raises(DataError) as caught:
        make_pair(RGB, DEPTH[:8], image_where="'a.jpg'", depth_where="'a.png'")
    assert message(caught) == ("'a.jpg' is 20 x 12 pixels but 'a.png' is 20 x 8. Both must have one size.")


@pytest.mark.parametrize("name", ["a.png", "kitchen/a b.png", "..a/b..png", "./a.png"])
def test_paths_inside(tmp_path: Path, name: str) -> None:
    assert inside(tmp_path, name, where="index") == tmp_path / name


@pytest.mark.parametrize(
    "name",
    ["", "/etc/passwd", "..", "../a.png", "a/../../b.png", "a\\..\\b.png", "C:\\a.png", "C:a.png", "a\0.png"],
)
def test_paths_outside(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError) as caught:
        inside(tmp_path, name, where="'index.csv' line 2")
    assert message(caught) == (
        f"'index.csv' line 2: path {name!r} is not inside the data folder. Use paths relative to '{tmp_path}'."
    )


@pytest.mark.parametrize("data", [b"a,b\nc,d\n", b"a,b\r\nc,d\r\n", b"\xef\xbb\xbfa,b\n\nc,d"])
def test_csv_rows(data: bytes) -> None:
    assert [cells for _, cells in csv_rows(data, where="")] == [["a", "b"], ["c", "d"]]


def test_csv_lines_are_counted_with_blank_ones() -> None:
    assert csv_rows(b"a\n\nb\n", where="") == [(1, ["a"]), (3, ["b"])]


def test_csv_that_is_none() -> None:
    with pytest.raises(DataError, match=r"^'x': not a CSV file in UTF-8 \(.*\)\. Write it again\.$"):
        csv_rows(b"a,\xff\xfe", where="'x'")


def test_handle_opens_once_a_process_and_stays_behind(tmp_path: Path) -> None:
    handles: PerProcess[bytes] = PerProcess(Path.read_bytes)
    path = tmp_path / "a"
    path.write_bytes(b"1")
    assert handles.get(path) == b"1"
    path.write_bytes(b"2")
    assert handles.get(path) == b"1"
    assert pickle.loads(pickle.dumps(handles)).get(path) == b"2"


def test_handle_opens_again_after_a_fork(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    handles: PerProcess[bytes] = PerProcess(Path.read_bytes)
    path = tmp_path / "a"
    path.write_bytes(b"1")
    handles.get(path)
    path.write_bytes(b"2")
    monkeypatch.setattr(os, "getpid", lambda: -1)
    assert handles.get(path) == b"2"


def test_anybodys_images_must_be_upright_and_published_ones_are_read_as_stored(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3  # upside down: sizes fit
    for folder in ("images", "2011_09_26/2011_09_26_drive_0001_sync/image_02/data"):
        (tmp_path / folder).mkdir(parents=True)
        Image.new("RGB", (8, 6)).save(tmp_path / folder / "0000000005.jpg", exif=exif)
    for folder in ("depths", "val/2011_09_26_drive_0001_sync/proj_depth/groundtruth/image_02"):
        (tmp_path / folder).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / folder / "0000000005.png"), np.full((6, 8), 2000, np.uint16))
    (tmp_path / "index.csv").write_text("image,depth\nimages/0000000005.jpg,depths/0000000005.png\n")
    for source in (FolderSource(tmp_path, encoding="uint16_mm"), ManifestSource(tmp_path, encoding="uint16_mm")):
        with pytest.raises(DataError, match=r"0000000005\.jpg': EXIF orientation 3, "):
            source.read(source.records()[0])
    kitti = KittiSource(tmp_path)
    assert kitti.read(kitti.records()[0]).image.shape == (6, 8, 3)
