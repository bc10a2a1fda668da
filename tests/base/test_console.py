"""Time spans in words, and progress that suits a terminal as well as a log file."""

from __future__ import annotations

import io
import logging
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import hudepth.base.console
from hudepth.base.console import duration, log, setup_logging, track, typed, wrap


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (0.4, "0 s"),
        (48, "48 s"),
        (59.6, "60 s"),
        (99.4, "99 s"),
        (99.5, "2 min"),
        (12 * 60, "12 min"),
        (99 * 60, "99 min"),
        (99.6 * 60, "1 h 40 min"),
        (3 * 3600 + 5 * 60, "3 h 05 min"),
        (2 * 3600 - 1, "2 h 00 min"),
        (50 * 3600, "50 h 00 min"),
    ],
)
def test_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@given(seconds=st.floats(0, 1e6))
def test_duration_is_within_its_last_place(seconds: float) -> None:
    text = duration(seconds)
    places = dict.fromkeys(["h", "min", "s"], 0) | {
        unit: int(number) for number, unit in re.findall(r"(\d+) (h|min|s)", text)
    }
    read = 3600 * places["h"] + 60 * places["min"] + places["s"]
    assert abs(read - seconds) <= (0.5 if text.endswith(" s") else 30)
    assert places["min"] < (60 if places["h"] else 100)


@pytest.fixture
def lines() -> Iterator[list[str]]:
    """What is logged."""
    heard: list[str] = []
    ear = logging.Handler()
    ear.emit = lambda record: heard.append(record.getMessage())  # type: ignore[method-assign]
    level = log.level
    log.addHandler(ear)
    log.setLevel(logging.INFO)
    yield heard
    log.removeHandler(ear)
    log.setLevel(level)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that goes when it is told to."""
    now = [100.0]
    monkeypatch.setattr(hudepth.base.console.time, "monotonic", lambda: now[0])
    return now


def plain(monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> io.StringIO:
    """Let progress go to a string."""
    out = io.StringIO()
    monkeypatch.setattr(hudepth.base.console, "console", Console(file=out, force_terminal=terminal, width=80))
    return out


def test_no_terminal_gives_a_line_every_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, lines: list[str], clock: list[float]
) -> None:
    out = plain(monkeypatch, terminal=False)
    seen = []
    for item in track(iter("abcdefgh"), total=8, what="preparing x"):
        seen.append(item)
        clock[0] += 6
    assert "".join(seen) == "abcdefgh"
    assert lines == [
        "preparing x: 2 of 8, 36 s left",
        "preparing x: 4 of 8, 24 s left",
        "preparing x: 6 of 8, 12 s left",
        "preparing x: 8 of 8, 0 s left",
    ]
    assert out.getvalue() == ""


def test_short_work_says_nothing(monkeypatch: pytest.MonkeyPatch, lines: list[str], clock: list[float]) -> None:
    out = plain(monkeypatch, terminal=False)
    assert list(track(range(5000), total=5000, what="x")) == list(range(5000))
    assert list(track([], total=0, what="x")) == []
    assert (lines, out.getvalue()) == ([], "")


def test_a_terminal_gets_a_bar(monkeypatch: pytest.MonkeyPatch, lines: list[str]) -> None:
    out = plain(monkeypatch, terminal=True)
    assert list(track(range(3), total=3, what="preparing x")) == [0, 1, 2]
    assert "preparing x" in out.getvalue()
    assert "3/3" in out.getvalue()
    assert lines == []


@pytest.mark.parametrize("terminal", [True, False])
def test_an_error_in_the_work_passes_through(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> None:
    plain(monkeypatch, terminal=terminal)

    def work() -> Iterator[int]:
        yield 1
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        list(track(work(), total=2, what="x"))


def test_logging_is_set_up_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name, value in (("handlers", []), ("propagate", True), ("level", 0)):
        monkeypatch.setattr(log, name, value)
    setup_logging()
    setup_logging()
    log.info("one %s", "line")
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "one line\n")


def test_a_line_does_not_steer_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    setup_logging()
    log.info("camera: %s", "NEX-\x1b]0;title\x07 \x9b2J\r of Köln\n  second line")
    assert capsys.readouterr().err == "camera: NEX-?]0;title? ?2J? of Köln\n  second line\n"


@given(text=st.text("abc /-=0", max_size=200), width=st.integers(20, 120))
def test_lines_are_broken_between_words_only(text: str, width: int) -> None:
    broken = wrap(text, width)
    assert broken.split() == text.split()
    assert all(len(line) <= width or len(line.split()) == 1 for line in broken.splitlines())


COMMANDS = (
    "hudepth-data download data=nyu_labeled_mat data.root=nyu",
    "hudepth-report sweep dir=sw",
    "hudepth-train -m loss=l1,silog 'data.fractions=[0.7, 0.1, 0.2]'",
    "pip install 'hudepth[search]'",
)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("place", [0, 5, 11, 19, 40])
def test_a_command_stays_whole_so_that_it_can_be_copied(command: str, place: int) -> None:
    line = f"{'x' * place} {command} and so on, in a sentence that goes on"
    broken = wrap(line, 30)
    assert command in broken
    assert " ".join(broken.split()) == line.strip()


def test_what_follows_a_break_is_indented() -> None:
    assert wrap("one two three", 8) == "one two\n  three"
    assert wrap("  one two three", 10) == "  one two\n    three"
    assert wrap("short\n\nlines", 8) == "short\n\nlines"


def test_a_log_line_fits_the_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    setup_logging()
    log.info("word " * 30)
    assert len(capsys.readouterr().err.splitlines()) == 1
    plain(monkeypatch, terminal=True)
    log.info("word " * 30)
    assert max(map(len, capsys.readouterr().err.splitlines())) <= 80


def test_a_command_is_spelt_as_one_types_it_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert typed("hudepth-test", checkpoint=tmp_path / "runs" / "a") == "hudepth-test checkpoint=runs/a"
    assert typed("hudepth-test", checkpoint=Path("/elsewhere/a")) == "hudepth-test checkpoint=/elsewhere/a"
    line = typed("hudepth-train", "trust=[a,b]", resume=tmp_path / "my runs" / "it's")
    assert shlex.split(line) == ["hudepth-train", "resume=my runs/it's", "trust=[a,b]"]
