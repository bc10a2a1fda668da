"""hudepth-data audit: from a list of names alone, and from images with copies hidden among them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.commands import TINY, Command

ROOMS = tuple(a for a in TINY if a.startswith("data.s"))
SCENES, FRAMES = 8, 6


def write_list(folder: Path) -> None:
    folder.mkdir(parents=True)
    names = [f"data/nyu2_train/room_{s:04d}_out/{f}" for s in range(SCENES) for f in range(1, FRAMES + 1)]
    (folder / "nyu2_train.csv").write_text("".join(f"{name}.jpg,{name}.png\n" for name in names), encoding="utf-8")


def write_frames(folder: Path, *, copies: bool) -> None:
    """Write frames of noise; with ``copies`` those of a scene are one image, else no two are alike."""
    rng = np.random.default_rng(0)
    for scene in range(SCENES):
        place = folder / "nyu2_train" / f"room_{scene:04d}_out"
        place.mkdir(parents=True)
        for frame in range(1, FRAMES + 1):
            if frame == 1 or not copies:
                image = cv2.resize(rng.integers(0, 256, (8, 8, 3), dtype=np.uint8), (64, 48))
            cv2.imwrite(str(place / f"{frame}.jpg"), image)
            cv2.imwrite(str(place / f"{frame}.png"), rng.integers(60, 200, (48, 64), dtype=np.uint8))


def report(folder: Path) -> Any:
    def refuse(word: str) -> None:
        raise AssertionError(word)

    return json.loads((folder / "audit.json").read_text(encoding="utf-8"), parse_constant=refuse)


ARGUMENTS = ("data", "audit", "data=densedepth", "data.root=nyu", "data.size=[32,48]", "paths.cache=cache")


def test_a_list_of_names_will_do(command: Command, tmp_path: Path) -> None:
    write_list(tmp_path / "nyu")
    done = command(*ARGUMENTS)
    assert done.code == 0, done.err
    first = Path("nyu/nyu2_train/room_0000_out/1.jpg")
    assert "images left out: 96 of 97 files" in done.err
    assert f"'{first}'" in done.err
    assert not (tmp_path / "cache").exists()
    for text in ("48 pairs", "33 / 4 / 11", "random *", "not looked at", "warning", "split=random"):
        assert text in done.out
    assert "official is not possible: the test subset is empty (48 pairs" in done.out
    found = report(tmp_path / "audit_densedepth")
    assert found["images"] is False
    assert found["splits"]["random"]["scene_seen"] == 1
    assert 0.5 < found["splits"]["random"]["within"]["1"] <= 1
    assert found["splits"]["scene"]["scene_seen"] == 0
    assert found["splits"]["scene"]["mean_distance_frames"] is None
    assert "the test subset is empty" in found["splits"]["official"]["not_possible"]
    assert not (tmp_path / "audit_densedepth" / "leaks.png").exists()


@pytest.mark.slow
def test_copies_are_found_and_shown(command: Command, tmp_path: Path) -> None:
    write_list(tmp_path / "nyu")
    write_frames(tmp_path / "nyu", copies=True)
    done = command(*ARGUMENTS, "output=here/deep")
    assert done.code == 0, done.err
    assert "written to here/deep: audit.json, leaks.png" in done.out
    found = report(tmp_path / "here" / "deep")
    assert found["splits"]["random"]["exact_duplicates"] == 1
    assert found["splits"]["scene"]["exact_duplicates"] == 0
    assert len({leak["test"].split("/")[0] for leak in found["leaks"]}) == len(found["leaks"]) == 6
    for leak in found["leaks"]:
        assert leak["equal"]
        assert leak["test"].split("/")[0] == leak["train"].split("/")[0]
        assert leak["frames_apart"] >= 1
    findings = {finding["about"]: finding for finding in found["findings"]}
    assert findings["repeated images"]["values"]["copies"] == SCENES * (FRAMES - 1)
    assert findings["step of depth"]["found"].startswith("39.2 mm")
    picture = cv2.imread(str(tmp_path / "here" / "deep" / "leaks.png"))
    assert picture.shape[0] > picture.shape[1]


@pytest.mark.slow
def test_images_that_differ_are_no_leak(command: Command, tmp_path: Path) -> None:
    write_list(tmp_path / "nyu")
    write_frames(tmp_path / "nyu", copies=False)
    assert command(*ARGUMENTS, "data.split=scene").code == 0
    found = report(tmp_path / "audit_densedepth")
    assert [found["splits"][kind]["near_duplicates"] for kind in ("random", "scene")] == [0, 0]
    assert found["findings"][0]["severity"] == "ok"
    assert not any(leak["near"] for leak in found["leaks"])


@pytest.mark.slow
def test_images_can_be_left_out_and_asked_for(command: Command, tmp_path: Path) -> None:
    write_list(tmp_path / "nyu")
    done = command(*ARGUMENTS, "images=true")
    assert done.code == 1
    assert "no file" in done.err.splitlines()[-1]
    write_frames(tmp_path / "nyu", copies=False)
    done = command(*ARGUMENTS, "images=false")
    assert done.code == 0
    assert "Pass images=true" in done.err
    assert not list((tmp_path / "cache").glob("*.h5"))
    done = command(*ARGUMENTS, "images=yes_please")
    assert "images: 'yes_please' is not one of auto, true, false" in done.err.splitlines()[-1]


@pytest.mark.slow
def test_large_sets_are_read_only_once_prepared(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hudepth.data.audit.run_audit.SMALL", 10)
    write_list(tmp_path / "nyu")
    write_frames(tmp_path / "nyu", copies=False)
    assert "48 pairs, not prepared" in command(*ARGUMENTS).err
    assert not report(tmp_path / "audit_densedepth")["images"]
    assert command("data", "prepare", *ARGUMENTS[2:]).code == 0
    assert "images left out" not in command(*ARGUMENTS).err
    assert report(tmp_path / "audit_densedepth")["images"]


@pytest.mark.slow
def test_bad_files_are_findings_and_the_rest_is_looked_at(command: Command, tmp_path: Path) -> None:
    write_list(tmp_path / "nyu")
    write_frames(tmp_path / "nyu", copies=False)
    place = tmp_path / "nyu" / "nyu2_train" / "room_0002_out"
    (place / "2.jpg").unlink()
    (place / "3.png").write_bytes((place / "3.png").read_bytes()[:500])
    cv2.imwrite(str(place / "4.png"), np.zeros((48, 64), np.uint8))
    cv2.imwrite(str(place / "5.png"), np.full((24, 32), 100, np.uint8))
    done = command(*ARGUMENTS)
    assert done.code == 0, done.err
    found = report(tmp_path / "audit_densedepth")
    assert (found["pairs"], found["images"]) == (44, True)
    (finding,) = (finding for finding in found["findings"] if finding["about"] == "unreadable pairs")
    assert finding["severity"] == "warning"
    lines = finding["values"]["skipped"]
    assert len(lines) == 4
    for line, text in zip(lines, ("no file", "3.png", "zero everywhere", "5.png"), strict=True):
        assert text in line


def test_wrong_units_are_a_finding_beside_the_leakage(command: Command, tmp_path: Path) -> None:
    write_list(tmp_path / "nyu")
    write_frames(tmp_path / "nyu", copies=False)
    wrong = (*ARGUMENTS, "data.encoding=uint16_mm")
    done = command(*wrong)
    assert done.code == 0, done.err
    found = report(tmp_path / "audit_densedepth")
    assert found["images"] is False
    assert found["splits"]["random"]["scene_seen"] == 1
    assert found["findings"][1]["found"] == "cannot be prepared"
    assert "Use data.encoding=uint8_10m" in found["findings"][1]["meaning"]
    asked = command(*wrong, "images=true")
    assert asked.code == 1
    assert "Use data.encoding=uint8_10m" in asked.err.splitlines()[-1]


def test_an_output_that_cannot_be_written(command: Command, tmp_path: Path) -> None:
    write_list(tmp_path / "nyu")
    (tmp_path / "taken").write_text("a file", encoding="utf-8")
    done = command(*ARGUMENTS, "output=taken/below")
    assert done.code == 1
    assert "output: cannot write to 'taken/below'" in done.err.splitlines()[-1]


@pytest.mark.slow
def test_rooms_are_audited_without_files(command: Command, tmp_path: Path) -> None:
    done = command("data", "audit", *ROOMS)
    assert done.code == 0, done.err
    assert "official *" in done.out
    found = report(tmp_path / "audit_rooms")
    assert (found["pairs"], found["scenes"], found["images"]) == (12, 6, True)
    assert all(set(split) >= {"within", "near_duplicates"} for split in found["splits"].values())


def test_a_split_that_cannot_be_made_is_said_so(command: Command, tmp_path: Path) -> None:
    write_list(tmp_path / "nyu")
    done = command(*ARGUMENTS, "data.split=official")
    assert done.code == 0, done.err
    assert report(tmp_path / "audit_densedepth")["findings"][0]["found"] == "not possible"


def test_the_verb_is_one_of_three(command: Command) -> None:
    done = command("data", "verb=adit")
    assert "verb: 'adit' is not one of" in done.err.splitlines()[-1]
