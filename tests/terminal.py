"""Console scripts as a person sees them: in a pseudo-terminal of a given width."""

from __future__ import annotations

import os
import re
import struct
import sys
from pathlib import Path

from rich.cells import cell_len

from tests.commands import Result

WIDTHS = (80, 100, 120)
_WHOLE = re.compile(r"\s*(\S+|(hudepth-|pip install ).*)")
"""What may be longer than the terminal, since it would be of no use in parts: a path, or a command to copy."""


def in_terminal(width: int, task: str, *arguments: str, cwd: Path, cache: Path) -> Result:
    """Run an installed console script in a terminal of ``width`` letters; both of its streams are ``out``.

    Colours are left out, and of a line that was written again and again, as a progress bar is, the states follow each
    other as lines.
    """
    import fcntl  # none of these is there on Windows
    import pty
    import termios

    process, terminal = pty.fork()
    if process == 0:
        os.chdir(cwd)
        script = str(Path(sys.executable).parent / f"hudepth-{task}")
        environment = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "LINES")}
        environment |= {"HUDEPTH_CACHE": str(cache), "OMP_NUM_THREADS": "1", "TERM": "xterm-256color"}
        os.execve(script, [script, *arguments], environment)
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 50, width, 0, 0))
    written = b""
    try:
        while part := os.read(terminal, 65536):
            written += part
    except OSError:  # Linux says that the process has ended
        pass
    os.close(terminal)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.decode())
    return Result(code, re.sub(r"\r+\n?", "\n", text), "")


def assert_fits(text: str, width: int) -> None:
    """Check that no line is wider than the terminal and nothing was shortened."""
    assert "…" not in text
    assert [x for x in text.splitlines() if cell_len(x) > width and not _WHOLE.fullmatch(x)] == []


def numbers(text: str) -> set[str]:
    """Return the numbers in a text as they are written, without signs."""
    return set(re.findall(r"\d+(?:\.\d+)?", text))
