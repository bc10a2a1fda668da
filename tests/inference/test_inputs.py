from __future__ import annotations

import re
from pathlib import Path

import pytest

from hudepth.base.errors import DataError
from hudepth.inference.inputs import find_inputs


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    files = "b.jpg a.PNG notes.txt .hidden.jpg walk.mp4 sub/c.webp sub/a.jpg twin.jpg twin.png"
    for name in files.split():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"")
    return tmp_path


def names(folder: Path, spec: str, *, recursive: bool = False) -> tuple[list[str], list[str]]:
    found = find_inputs(spec, recursive=recursive)
    return [str(item.stem) for item in found.images], [str(item.stem) for item in found.videos]


def test_a_folder(folder: Path) -> None:
    assert names(folder, str(folder)) == (["a", "b", "twin_jpg", "twin_png"], ["walk"])
    images, videos = names(folder, str(folder), recursive=True)
    assert images == ["a", "b", "sub/a", "sub/c", "twin_jpg", "twin_png"]
    assert videos == ["walk"]


def test_a_pattern_a_file_and_a_camera(folder: Path) -> None:
    assert names(folder, f"{folder}/*.jpg") == (["b", "twin"], [])
    assert names(folder, f"{folder}/**/*.webp") == (["sub/c"], [])
    assert names(folder, str(folder / "walk.mp4")) == ([], ["walk"])
    assert names(folder, str(folder / "notes.txt")) == (["notes"], [])  # whoever names a file means it
    assert find_inputs("2", recursive=False) == ([], [], 2)


def test_a_folder_whose_name_is_a_number(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    (folder / "7").mkdir()
    (folder / "7" / "x.jpg").write_bytes(b"")
    assert names(folder, "7") == (["x"], [])


def test_nothing(folder: Path) -> None:
    with pytest.raises(DataError, match=r"input: no file, folder or match 'nowhere'\. Pass an image, folder"):
        find_inputs("nowhere", recursive=False)
    (folder / "empty").mkdir()
    message = f"input: no image or video in '{folder}/empty' (.jpg,"
    with pytest.raises(DataError, match=re.escape(message) + ".*recursive=true"):
        find_inputs(f"{folder}/empty", recursive=False)
