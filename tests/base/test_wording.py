from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from hudepth.base.wording import one_line


@pytest.mark.parametrize(
    ("code", "fix"),
    [
        (errno.ENOSPC, "Free some space"),
        (errno.EROFS, "folder"),
        (errno.EACCES, "folder"),
        (errno.EFBIG, "ulimit"),
        (errno.EISDIR, "Remove the folder"),
        (errno.ENAMETOOLONG, "shorter"),
    ],
)
def test_a_file_that_cannot_be_written(code: int, fix: str) -> None:
    line = one_line(OSError(code, os.strerror(code), "runs/x/metrics.json"), "test")
    assert line.startswith("'runs/x/metrics.json' cannot be written")
    assert fix in line
    assert "debug" not in line


def test_the_file_of_an_error_while_it_is_written(tmp_path: Path) -> None:
    from hudepth.base.files import written_whole

    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(OSError, match="space") as caught, written_whole(tmp_path / "a.json"):
        raise full
    assert str(tmp_path / "a.json") in one_line(caught.value, "test")
    assert not list(tmp_path.iterdir())


def test_errors_that_are_each_others_context_end() -> None:
    one, other = OSError(28, "No space left on device"), RuntimeError("at the end")
    one.__context__, other.__context__ = other, one
    assert "No space left" in one_line(one, "train")
