"""Contents decide which sets are equal, and a file is only read again if it changed."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from hudepth.data.prepare import prepare, store_path
from hudepth.data.sources.contents import hash_contents
from hudepth.data.sources.folder import FolderSource
from hudepth.data.sources.rooms import RoomsSource


def write_set(root: Path, depth_m: float) -> FolderSource:
    for folder in ("images", "depths"):
        (root / folder).mkdir(parents=True)
    for i in range(3):
        cv2.imwrite(str(root / f"images/{i}.png"), np.full((6, 8, 3), 40 * i, np.uint8))
        np.save(root / f"depths/{i}.npy", np.full((6, 8), depth_m, np.float32))
    for path in root.rglob("*.*"):
        os.utime(path, (0, 0))
    return FolderSource(root, encoding="float_m")


def test_sets_of_equal_names_sizes_and_times_never_share_a_store(tmp_path: Path) -> None:
    sets = [write_set(tmp_path / name, depth) for name, depth in (("metres", 2.0), ("halved", 1.0))]
    stores = [prepare(source, size=(6, 8), cache=tmp_path / "cache") for source in sets]
    assert [float(store.read_native(0).max()) for store in stores] == [2.0, 1.0]


def test_equal_sets_share_a_store(tmp_path: Path) -> None:
    sets = [write_set(tmp_path / name, 2.0) for name in ("one", "copy")]
    assert len({store_path(source, size=(6, 8), native=True, cache=tmp_path) for source in sets}) == 1


def test_only_what_changed_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, read = write_set(tmp_path / "set", 2.0), []
    digest = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda file, kind: (read.append(file.name), digest(file, kind))[1])
    monkeypatch.setattr("hudepth.data.sources.contents._SETTLED_NS", -(10**12))
    first = hash_contents(source.name, source.files(), cache=tmp_path)
    assert len(read) == 6
    assert hash_contents(source.name, source.files(), cache=tmp_path) == first
    assert len(read) == 6
    np.save(tmp_path / "set/depths/1.npy", np.full((6, 8), 3, np.float32))
    os.utime(tmp_path / "set/depths/1.npy", (0, 0))
    assert hash_contents(source.name, source.files(), cache=tmp_path) != first
    assert len(read) == 7
    next(tmp_path.glob("contents-*.json")).write_text("[" * 100_000)
    hash_contents(source.name, source.files(), cache=tmp_path)
    assert len(read) == 13


def test_what_never_ends_is_not_read(tmp_path: Path) -> None:
    source = write_set(tmp_path / "set", 2.0)
    before = hash_contents(source.name, source.files(), cache=tmp_path)
    file = tmp_path / "set/depths/1.npy"
    file.unlink()
    file.symlink_to("/dev/zero")
    zeros = hash_contents(source.name, source.files(), cache=tmp_path)
    file.unlink()
    os.mkfifo(file)
    assert zeros == hash_contents(source.name, source.files(), cache=tmp_path) != before


def test_generated_sources_have_no_files(tmp_path: Path) -> None:
    assert hash_contents("rooms", RoomsSource(scenes=2).files(), cache=tmp_path) == ""
