"""Files appear whole or not at all, whatever happens while they are written."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import ConfigError
from hudepth.base.files import (
    output_folder,
    read_json,
    read_text,
    read_yaml,
    remove_leftovers,
    write_between,
    write_json,
    write_text,
    written_whole,
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_when_its_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "a.bin"
    with written_whole(path) as part:
        assert part.parent == path.parent  # else the rename might have to copy
        part.write_bytes(b"whole")
        assert not path.exists()
    assert path.read_bytes() == b"whole"
    assert names(path.parent) == ["a.bin"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_the_earlier_file(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    path.write_text("earlier")

    def fail() -> None:
        with written_whole(path) as part:
            part.write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_text() == "earlier"
    assert names(tmp_path) == ["a.txt"]


def test_readers_of_the_earlier_file_keep_it(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "earlier")
    with path.open() as reader:
        write_text(path, "later")
        assert reader.read() == "earlier"
    assert path.read_text() == "later"


def test_a_block_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), written_whole(tmp_path / "a.txt"):
        pass
    assert names(tmp_path) == []


def test_a_failing_disk_leaves_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_text(tmp_path / "a.txt", "earlier")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device"):
        write_text(tmp_path / "a.txt", "later")
    assert (tmp_path / "a.txt").read_text() == "earlier"
    assert names(tmp_path) == ["a.txt"]


def test_a_kill_leaves_the_earlier_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("earlier")
    script = (
        "import os, signal, sys; from pathlib import Path; from hudepth.base.files import written_whole\n"
        "with written_whole(Path(sys.argv[1])) as part:\n"
        "    part.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    process = subprocess.Popen([sys.executable, "-c", script, str(path)], env=environment)
    assert process.wait(timeout=60) == -signal.SIGKILL
    assert path.read_text() == "earlier"
    assert names(tmp_path) == [f".a.txt.{process.pid}.part", "a.txt"]


def test_text_is_utf8(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "Tiefe ±1 m\n")
    assert (tmp_path / "a.txt").read_bytes() == "Tiefe ±1 m\n".encode()


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(value=JSON)
def test_json_comes_back(value: object, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "value.json"
    write_json(path, value)
    text = path.read_text(encoding="utf-8")
    assert json.loads(text) == value
    assert text.endswith("\n")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_json_has_no_word_for_nan(tmp_path: Path, value: float) -> None:
    write_json(tmp_path / "a.json", {"rmse": 0.5})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"rmse": value})
    assert json.loads((tmp_path / "a.json").read_text()) == {"rmse": 0.5}
    assert names(tmp_path) == ["a.json"]


def test_writing_between_markers_leaves_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    path.write_text("# title\n<!-- a -->\nold\nlines\n<!-- a -->\nend, äö\n<!-- b -->\n<!-- b -->\n", encoding="utf-8")
    write_between(path, "a", "\nnew \\1\n")
    write_between(path, "b", "| x |")
    expected = "# title\n<!-- a -->\nnew \\1\n<!-- a -->\nend, äö\n<!-- b -->\n| x |\n<!-- b -->\n"
    assert path.read_text(encoding="utf-8") == expected
    with pytest.raises(ValueError, match=r"needs two lines '<!-- c -->' and has 0\.$"):
        write_between(path, "c", "x")


def test_only_regular_files_are_read_and_only_so_much(tmp_path: Path) -> None:
    (tmp_path / "zero").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    for name in ("zero", "pipe"):
        with pytest.raises(OSError, match="regular"):
            read_text(tmp_path / name)
    (tmp_path / "long").write_text("x" * 11)
    with pytest.raises(OSError, match="larger"):
        read_text(tmp_path / "long", limit=10)


def test_deep_and_multiplying_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_text("[" * 200_000 + "]" * 200_000)
    with pytest.raises(ValueError, match="deep"):
        read_json(path)
    laughs = "\n".join([f"a0: &a0 [{'x,' * 9}]", *(f"a{i}: &a{i} [{f'*a{i - 1},' * 9}]" for i in range(1, 12))])
    for text in ("[" * 200_000, laughs, "&a [*a]"):
        path.write_text(text)
        with pytest.raises(yaml.YAMLError):
            read_yaml(path)
    path.write_text("2024-13-45")
    with pytest.raises(yaml.YAMLError, match="month"):
        read_yaml(path)


def test_what_killed_processes_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    (tmp_path / "eigen").mkdir()
    names = (f".a.json.{ended.pid}.part", f"eigen/.b.png.{ended.pid}.part", f".c.{ended.pid}.part.webm")
    dead = [tmp_path / name for name in names]
    kept = [tmp_path / f".a.json.{os.getpid()}.part", tmp_path / ".hidden", tmp_path / "x.part"]
    for path in (*dead, *kept):
        path.write_text("x")
    folder = tmp_path / f".export-{ended.pid}-abc"
    (folder / "deep").mkdir(parents=True)
    remove_leftovers(tmp_path)
    assert not any(path.exists() for path in (*dead, folder))
    assert all(path.exists() for path in kept)


def test_a_link_out_of_a_run_is_refused(tmp_path: Path) -> None:
    run, other = tmp_path / "run", tmp_path / "other"
    run.mkdir()
    other.mkdir()
    (run / "figures").symlink_to(other)
    (run / "test").mkdir()
    (run / "test" / "eigen").symlink_to(other)
    for name in ("figures", "test"):
        with pytest.raises(ConfigError, match="leads out"):
            output_folder(run / name, within=run)
    assert not list(other.iterdir())
    assert output_folder(run / "figures") == run / "figures"  # as typed
