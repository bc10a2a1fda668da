"""Log lines and progress bars on standard error."""

from __future__ import annotations

import logging
import re
import shlex
import sys
import textwrap
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from hudepth.base.verbs import SUBCOMMANDS

T = TypeVar("T")

console = Console(stderr=True)
"""Progress and log lines; results go to standard output."""

log = logging.getLogger("hudepth")

_shown = {"level": logging.INFO}
"""The lowest level of log lines that reach the terminal."""


_VERBS = "|".join(verb for verbs in SUBCOMMANDS.values() for verb in verbs)
_COMMAND = re.compile(rf"hudepth-\w+( ({_VERBS})\b| -m\b)?( '[^']*'| [+\w.]+=\S+)*|pip install \S+")
"""A command in a sentence."""


class _CurrentStderr(logging.Handler):
    """Writes to the current ``sys.stderr``: a progress bar replaces it, to stay below log lines."""

    def emit(self, record: logging.LogRecord) -> None:
        print_error(plain(self.format(record)))


def print_error(text: str) -> None:
    """Print to standard error; in a terminal, long lines are broken between words."""
    print(wrap(text, console.width) if console.is_terminal else text, file=sys.stderr, flush=True)


def wrap(text: str, width: int, *, indent: str = "  ") -> str:
    """Break lines longer than ``width`` [letters] between words.

    Commands and paths, which somebody may copy, stay whole and may be longer. What follows a break is indented by
    ``indent`` more than the line began.
    """
    lines = []
    for line in text.split("\n"):
        whole = _COMMAND.sub(lambda found: found[0].replace(" ", "\0"), line)
        begin = line[: len(line) - len(line.lstrip())]
        broken = textwrap.wrap(
            whole.lstrip(), max(1, width), initial_indent=begin, subsequent_indent=begin + indent,
            break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
        lines += [line] if len(line) <= width else [each.replace("\0", " ") for each in broken]
    return "\n".join(lines)


def plain(text: str) -> str:
    """Return text without what steers a terminal: names and descriptions come from files of strangers."""
    return "".join(each if each.isprintable() or each == "\n" else "?" for each in text)


def setup_logging(level: int = logging.INFO, *, prefix: str = "") -> None:
    """Send hudepth's log lines to standard error, and nowhere else.

    Args:
        level: of the lines that are shown; a run's own log has all from INFO on.
        prefix: before each of them.
    """
    handler = _CurrentStderr(level)
    handler.setFormatter(logging.Formatter(f"{prefix.replace('%', '%%')}%(message)s"))
    log.handlers[:] = [handler]
    log.setLevel(logging.INFO)
    _shown["level"] = level
    log.propagate = False


def shows_progress() -> bool:
    """Whether a live progress bar makes sense here: in a terminal, and not in a job of a sweep, which is silent."""
    return console.is_terminal and _shown["level"] <= logging.INFO


def track(items: Iterable[T], *, total: int, what: str) -> Iterator[T]:
    """Yield ``items`` under a progress bar; where there is no terminal, as a line every ten seconds.

    Args:
        items: what to go through.
        total: how many there are.
        what: shown before the bar, for example ``preparing nyu_labeled``.
    """
    if shows_progress():
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True) as progress:
            yield from progress.track(items, total=total, description=what)
        return
    start = last = time.monotonic()
    for done, item in enumerate(items, start=1):
        yield item
        now = time.monotonic()
        if now - last > 10:
            last = now
            log.info("%s: %d of %d, %s left", what, done, total, duration((now - start) / done * (total - done)))


def typed(command: str, *options: str, **paths: Path) -> str:
    """Return a command with options that are paths, ``checkpoint=runs/x``, as one types it in this folder."""
    here = Path.cwd()
    short = {key: path.relative_to(here) if path.is_relative_to(here) else path for key, path in paths.items()}
    return shlex.join([command, *(f"{key}={path}" for key, path in short.items()), *options])


def duration(seconds: float) -> str:
    """Spell a time span: ``48 s``, ``12 min``, ``3 h 05 min``."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"
