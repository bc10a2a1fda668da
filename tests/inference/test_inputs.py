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
    assert find_inputs("2", recursive=False).camera == 2


def test_a_folder_whose_name_is_a_number(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    (folder / "7").mkdir()
    (folder / "7" / "x.jpg").write_bytes(b"")
    assert names(folder, "7") == (["x"], [])


def test_results_are_no_inputs(folder: Path) -> None:
    for name in ("out/x.jpg", "old/a_depth.png", "old/predictions.json", "old/walk/000000_depth.jpg", "my_side.jpg"):
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_bytes(b"")
    found = find_inputs(str(folder), recursive=True, output=folder / "out")
    assert [str(item.stem) for item in found.images if item.stem.parts[0] in ("out", "old", "my_side")] == ["my_side"]
    line = next(line for line in found.left_out if "results" in line)
    assert ": 3 (" in line
    assert "x.jpg" in line


def test_photographs_by_phones_and_what_is_left_out(folder: Path) -> None:
    for name in ("p.HEIC", "p.avif", "p.jfif", "p.MTS", "bare"):
        (folder / name).write_bytes(b"\xff\xd8\xff\xe0" if name == "bare" else b"")
    (folder / "Makefile").write_bytes(b"all:")
    found = find_inputs(str(folder), recursive=False)
    images = {item.path.name for item in found.images}
    assert {"p.HEIC", "p.avif", "p.jfif", "bare"} <= images
    assert "p.MTS" in {item.path.name for item in found.videos}
    assert found.left_out == (
        "left out, neither image nor video: 2 (Makefile, notes.txt)",
        "left out, hidden: 1 (.hidden.jpg)",
        "left out, subfolders, which recursive=true searches: 1 (sub)",
    )
    without = find_inputs(str(folder), recursive=True, output=folder / "sub").left_out
    assert [line.split(":")[0] for line in without if "subfolders" in line] == []


def test_nothing(folder: Path) -> None:
    with pytest.raises(DataError, match=r"input: no file, folder or match 'nowhere'\. Pass an image, folder"):
        find_inputs("nowhere", recursive=False)
    (folder / "empty").mkdir()
    message = f"input: no image or video in '{folder}/empty' (.jpg,"
    with pytest.raises(DataError, match=re.escape(message) + ".*recursive=true"):
        find_inputs(f"{folder}/empty", recursive=False)
