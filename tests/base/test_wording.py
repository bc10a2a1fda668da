from __future__ import annotations

from hudepth.base.wording import one_line


def test_errors_that_are_each_others_context_end() -> None:
    one, other = OSError(28, "No space left on device"), RuntimeError("at the end")
    one.__context__, other.__context__ = other, one
    assert "No space left" in one_line(one, "train")
