from __future__ import annotations

import contextlib
import os
from pathlib import Path

import cv2
import numpy as np

from hudepth.demo.answers import Limits, answer
from hudepth.demo.session_files import DOWNLOADS, EXAMPLE_ROOMS, Files, draw_examples
from hudepth.inference.model import DepthModel

from .conftest import encoded


def uploaded(files: Files, name: str = "a.png") -> Path:
    path = files.uploads / "hash" / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(encoded(60, 80))
    return path


def kept(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_the_folder_goes_with_the_page_whatever_happens() -> None:
    files = Files()
    with contextlib.suppress(RuntimeError), files:
        uploaded(files)
        raise RuntimeError
    assert not files.root.exists()


def test_a_session_keeps_its_last_picture_alone(model: DepthModel) -> None:
    with Files() as files:
        for name in ("a.png", "b.png"):
            path = uploaded(files, name)
            files.begin("one", path)
            written = files.write("one", answer(path, model, Limits(2**20, 10**6)))
        assert kept(files.uploads) == [path]
        assert sorted(kept(files.results)) == sorted(written)
        files.begin("one", path)  # the same once more
        assert path.exists()
        files.end("one")
        files.end("one")
        assert kept(files.root) == []


def test_what_two_sessions_share_stays_until_both_are_gone() -> None:
    with Files() as files:
        path = uploaded(files)
        for session in ("one", "two"):
            files.begin(session, path)
        files.end("one")
        assert path.exists()
        files.end("two")
        assert not path.exists()


def test_the_oldest_go_when_all_hold_too_much() -> None:
    with Files(keep_bytes=100_000) as files:
        paths = []
        for number in range(10):
            paths.append(files.uploads / str(number) / "a.png")
            paths[-1].parent.mkdir()
            paths[-1].write_bytes(bytes(30_000))  # whose session never opens
            os.utime(paths[-1].parent, (number, number))
        files.trim()
        assert [path.exists() for path in paths] == [False] * 8 + [True] * 2
        for number in range(5):
            path = files.results / str(number) / "a.npy"
            path.parent.mkdir()
            path.write_bytes(bytes(300_000))
            os.utime(path.parent, (100 + number, 100 + number))
            files.trim()
            assert kept(files.root) == [path]  # the newest stays, whatever its size


def test_examples_and_strange_paths_are_never_deleted(tmp_path: Path) -> None:
    with Files() as files:
        for path in (files.examples / "kitchen.jpg", tmp_path / "mine.jpg"):
            path.write_bytes(b"")
            files.begin("one", path)
            files.end("one")
            assert path.exists()


def test_the_downloads_agree(model: DepthModel) -> None:
    with Files() as files:
        result = answer(uploaded(files), model, Limits(2**20, 10**6))
        written = files.write("one", result)
        paths = [path for path in written if path is not None]
        colours, png, npy, ply, glb = paths
        metres = np.load(npy)
        millimetres = cv2.imread(str(png), cv2.IMREAD_UNCHANGED)
        head, _, body = ply.read_bytes().partition(b"end_header\n")
        assert glb.read_bytes()[:4] == b"glTF"
        assert cv2.imread(str(colours)).shape[0] == 60
    assert [path.name for path in paths] == [f"a_depth.{ending}" for ending in ("jpg", "png", "npy", "ply", "glb")]
    assert len(DOWNLOADS) == 5
    assert metres.dtype == np.float32
    assert millimetres.dtype == np.uint16
    assert np.abs(metres - millimetres / 1000).max() <= 0.00051
    points = np.frombuffer(body, [("p", "<f4", 3), ("c", "u1", 3)])
    np.testing.assert_array_equal(points["p"], result.depth.point_cloud(edges=False).points_m)
    assert b"not this camera's own" in head


def test_a_format_that_cannot_hold_the_picture_is_left_out(model: DepthModel) -> None:
    with Files() as files:
        path = files.uploads / "a.png"
        path.write_bytes(encoded(1, 66_000))  # longer than a JPEG can be
        written = files.write("one", answer(path, model, Limits(2**20, 10**6)))
        assert [path is None for path in written] == [True, False, False, False, False]
        assert sorted(kept(files.results)) == sorted(path for path in written if path)


def test_examples_are_rooms_of_different_kinds(tmp_path: Path) -> None:
    paths = draw_examples(tmp_path)
    assert len({path.stem for path in paths}) == len(EXAMPLE_ROOMS) == 4
    assert cv2.imread(str(paths[0])).shape == (480, 640, 3)
