"""What autodoc shows: types without the checks of options, arrays by their short name, links and lines as written."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import is_dataclass
from typing import Any, get_type_hints

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

ARRAY = "ndarray[tuple[Any, ...], dtype["
"""What ``NDArray[T]`` is short for, up to T."""


def leave_out_checks(_: Sphinx, described: Any, *__: Any) -> None:
    """Turn ``Annotated[float, Range(0)]`` into ``float``."""
    own = getattr(described, "__annotations__", {})
    source = described
    if getattr(described, "__name__", "") == "__init__":
        owner = getattr(sys.modules[described.__module__], described.__qualname__.partition(".")[0], None)
        source = owner if is_dataclass(owner) else described  # inherited fields are written as in their own module
    with suppress(NameError, TypeError, AttributeError):  # of types that are imported for type checkers alone
        hints = get_type_hints(source)
        described.__annotations__ = {name: hints.get(name, own[name]) for name in own}


def name_factories(_: Sphinx, *rest: Any) -> tuple[str | None, str | None]:
    """Write ``...`` for a default that is made anew, so that the signature is Python."""
    arguments, result = rest[-2:]
    return arguments and arguments.replace("<factory>", "..."), result


def keep_first_line(app: Sphinx, what: str, _: str, described: Any, __: Any, lines: list[str]) -> None:
    """Keep napoleon from taking what stands before a colon for a type, and show the attributes of classes plainly."""
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]  # an empty comment
    if isinstance(described, type):
        leave_out_checks(app, described)


def name_arrays(_: Sphinx, domain: str, __: str, content: addnodes.desc_content) -> None:
    """Write ``NDArray[T]`` in signatures."""
    for signature in content.parent.findall(addnodes.desc_signature) if domain == "py" else ():
        for part in list(signature.findall(lambda node: isinstance(node, nodes.Element) and ARRAY in node.astext())):
            while (place := _array(part)) is not None:
                start, end = place
                kind = "".join(node.astext() for node in part.children[start:end]).removeprefix(ARRAY)[:-2]
                part[start:end] = [nodes.Text(f"NDArray[{kind}]")]


def _array(part: nodes.Element) -> tuple[int, int] | None:
    """Return where the nodes of an array are among the children of an element."""
    texts = [node.astext() for node in part.children]
    for start, text in enumerate(texts):
        if text == "ndarray" and "".join(texts[start:]).startswith(ARRAY):
            depth, end = 0, start + 1
            while True:
                depth += texts[end].count("[") - texts[end].count("]")
                end += 1
                if not depth:
                    return start, end
    return None


def find_short_name(app: Sphinx, env: BuildEnvironment, node: nodes.Element, content: nodes.Node) -> nodes.Node | None:
    """Find ``scaling_loss`` of a docstring: the object of that name, in whatever module, if there is only one."""
    if node.get("refdomain") != "py" or "." in (target := str(node["reftarget"]).removeprefix("~")).partition(".")[2]:
        return None
    python = env.domains.python_domain
    found = {entry.node_id: name for name, entry in python.objects.items() if name.endswith(f".{target}")}
    if len(found) != 1:
        return None
    (name,) = found.values()
    return python.resolve_xref(env, node["refdoc"], app.builder, "obj", name, node, content)  # type: ignore[arg-type]


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect with autodoc."""
    app.connect("autodoc-before-process-signature", leave_out_checks)
    app.connect("autodoc-process-signature", name_factories)
    app.connect("autodoc-process-docstring", keep_first_line, priority=400)  # before napoleon
    app.connect("object-description-transform", name_arrays)
    app.connect("missing-reference", find_short_name)
    return {"parallel_read_safe": True}
