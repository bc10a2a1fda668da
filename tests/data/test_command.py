from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from hudepth.data.store import DepthStore
from tests.commands import TINY, Command

ROOMS = tuple(a for a in TINY if a.startswith("data.s"))


def write_pairs(folder: Path, *, dtype: type = np.uint16, value: int = 2000, count: int = 10) -> None:
    for kind in ("images", "depths"):
        (folder / kind).mkdir(parents=True)
    for i in range(count):
        cv2.imwrite(str(folder / "images" / f"{i}.png"), np.full((48, 64, 3), 10 * i, np.uint8))
        cv2.imwrite(str(folder / "depths" / f"{i}.png"), np.full((48, 64), value, dtype))


def test_prepare_and_info(command: Command) -> None:
    first = command("data", "prepare", *ROOMS)
    assert first.code == 0, first.err
    assert first.out.startswith("12 pairs in ")
    store = DepthStore(first.out.strip().split(" in ")[1])
    assert len(store) == 12
    info = command("data", "info", *ROOMS)
    assert info.code == 0, info.err
    for text in ("pairs", "12", "split=random", "8 train, 1 val, 3 test", "store"):
        assert text in info.out


def test_prepare_prints_the_range_in_metres(command: Command, tmp_path: Path) -> None:
    write_pairs(tmp_path / "mine")
    done = command("data", "prepare", "data=folder", "data.root=mine", "data.encoding=uint16_mm", "paths.cache=cache")
    assert done.code == 0, done.err
    assert "folder: 10 pairs, depth 2.00 to 2.00 m (median 2.00 m, encoding uint16_mm), 100.0 % of pixels" in done.err


def test_wrong_units_are_refused_with_a_fix(command: Command, tmp_path: Path) -> None:
    write_pairs(tmp_path / "mine", dtype=np.uint8, value=200)
    arguments = ("data", "prepare", "data=folder", "data.root=mine", "paths.cache=cache")
    done = command(*arguments, "data.encoding=uint16_mm")
    assert done.code == 1
    assert "Use data.encoding=uint8_10m" in done.err.splitlines()[-1]
    assert command(*arguments).err.splitlines()[-1].startswith("hudepth-data: data.encoding is not set")
    assert command(*arguments, "data.encoding=uint8_10m").code == 0
    literal = command(*arguments, "data.encoding=paper_literal")
    assert literal.code == 0
    assert "depth 0.20 to 0.20 m" in literal.err


def test_bad_files_are_named_or_skipped(command: Command, tmp_path: Path) -> None:
    write_pairs(tmp_path / "mine")
    whole = (tmp_path / "mine" / "images" / "3.png").read_bytes()
    (tmp_path / "mine" / "images" / "3.png").write_bytes(whole[: len(whole) // 2])
    arguments = ("data", "prepare", "data=folder", "data.root=mine", "data.encoding=uint16_mm", "paths.cache=cache")
    done = command(*arguments)
    assert done.code == 1
    assert "3.png" in done.err.splitlines()[-1]
    assert "data.on_error=skip" in done.err.splitlines()[-1]
    assert not list((tmp_path / "cache").glob("*.h5"))
    skipped = command(*arguments, "data.on_error=skip")
    assert skipped.code == 0
    assert skipped.out.startswith("9 pairs in ")
    assert "folder: 1 pairs skipped:" in skipped.err


@pytest.mark.slow
def test_an_option_of_another_type_is_named(tmp_path: Path) -> None:
    """Without the checks of types that tests have."""
    wrong = {"data.progressive": "-inf", "data.fractions": "none", "data.split": "[null,null]"}
    code = "import sys; from hudepth import cli; sys.argv[1:] = ['info', 'data=rooms', '{}={}']; assert cli.data() == 1"
    lines = "\n".join(code.format(*each) for each in wrong.items())
    done = subprocess.run([sys.executable, "-c", lines], cwd=tmp_path, text=True, capture_output=True, check=True)
    assert [line.split(": ")[1] for line in done.stderr.splitlines()] == list(wrong)
