"""What autodoc shows: types without the checks of options, NDArray by its name, and first lines as they are."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import Any, get_type_hints

from sphinx.application import Sphinx

ARRAY = re.compile(r"(?:~?numpy\.)?ndarray\[tuple\[(?:~?typing\.)?Any, \.\.\.\], (?:~?numpy\.)?dtype\[([^]]*)\]\]")


def leave_out_checks(_: Sphinx, described: Any, *__: Any) -> None:
    """Turn ``Annotated[float, Range(0)]`` into ``float``."""
    own = getattr(described, "__annotations__", {})
    with suppress(NameError, TypeError, AttributeError):  # of types that are imported for type checkers alone
        hints = get_type_hints(described)
        described.__annotations__ = {name: hints[name] for name in own}


def shorten(_: Sphinx, *rest: Any) -> tuple[str | None, str | None]:
    """Return arguments and result of a signature with NDArray instead of what it stands for."""
    arguments, result = (text and ARRAY.sub(r"NDArray[\1]", text) for text in rest[-2:])
    return arguments, result


def keep_first_line(_: Sphinx, what: str, name: str, described: Any, options: Any, lines: list[str]) -> None:
    """Keep napoleon from taking what stands before a colon for a type, and show the attributes of classes plainly."""
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]  # an empty comment
    if isinstance(described, type):
        leave_out_checks(_, described)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect with autodoc."""
    app.connect("autodoc-before-process-signature", leave_out_checks)
    app.connect("autodoc-process-signature", shorten)
    app.connect("autodoc-process-docstring", keep_first_line, priority=400)  # before napoleon
    return {"parallel_read_safe": True}
