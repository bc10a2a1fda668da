"""The directive ``option-tables``: every key of conf/, with its value and its comment."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

CONF = Path(__file__).parents[2] / "conf"
LINE = re.compile(r"(?P<indent> *)(?P<key>[\w.]+):(?: (?P<value>[^\s#].*?))??(?: *(?<!\S)# (?P<comment>.*))?")
TITLES = {"Commands": "Commands", "base": "every protocol=", "paths": "paths"}
PREFIXES = {"base": "protocol.<name>"}
"""Of keys, where it is not the path of the folder."""
COMPOSITIONS = ("experiment", "sweep", "debug")
"""Groups whose files set keys of others: shown as they are."""
SHARED = ("base", "default")
COMMANDS = ("train", "test", "predict", "data", "report", "export", "bench", "demo")
GROUPS = (
    "data", "model", "augment", "loss", "distill", "auxiliary", "optim", "schedule", "trainer", "callbacks", "logger",
    "base", "protocol", *COMPOSITIONS, "hydra/sweeper", "hydra/launcher", "paths",
)  # fmt: skip
"""In the order of the page."""


class Option(NamedTuple):
    """A key of a configuration."""

    key: str
    value: str
    comment: str


class Configuration(NamedTuple):
    """A file of conf/."""

    about: str
    target: str
    """The class that it configures; empty if there is none."""
    options: list[Option]


def read(path: Path) -> Configuration:
    """Read a file's keys in order, each with the comment behind it or on the lines before it."""
    lines = path.read_text(encoding="utf-8").splitlines()
    top = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    about = [line.removeprefix("#").removeprefix(" ") for line in lines[:top] if not line.startswith("# @package")]
    options, target = [], ""
    parents: list[tuple[int, str]] = []
    waiting: list[str] = []
    for line in lines[top:]:
        if line.strip().startswith("# "):
            waiting.append(line.strip().removeprefix("# "))
            continue
        found = LINE.fullmatch(line)
        if not found:
            waiting = []
            continue  # an entry of a list, or empty
        indent, key, value = len(found["indent"]), found["key"], found["value"] or ""
        parents = [parent for parent in parents if parent[0] < indent]
        outer = [name for _, name in parents]
        parents.append((indent, key))
        comment = " ".join([*waiting, *filter(None, [found["comment"]])])
        waiting = []
        if key == "_target_":
            target = target or ("" if value == "null" else value)
        elif "defaults" not in (key, *outer) and (value or comment):
            options.append(Option(".".join([*outer, key]), value, comment))
    return Configuration("\n".join(about).strip(), target, options)


def prefix(path: Path) -> str:
    """Return what stands before a file's keys on the command line, with its dot."""
    package = re.search(r"^# @package ([\w.]+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    folder = path.parent.relative_to(CONF).as_posix().replace("/", ".")
    start = package[1] if package else PREFIXES.get(folder, "" if folder == "." else folder)
    return f"{start}." if start else ""


def groups() -> Iterator[tuple[str, list[Path]]]:
    """Yield the commands, then each group, with their files; those that others start from first."""
    yield "Commands", [CONF / f"{command}.yaml" for command in COMMANDS]
    for name in GROUPS:
        yield name, sorted((CONF / name).glob("*.yaml"), key=lambda path: (path.stem not in SHARED, path.stem))


def known_comments(files: Iterable[Path]) -> dict[str, str]:
    """Return the first comment on each key of a group, for files that only change its value."""
    known: dict[str, str] = {}
    for path in files:
        known = {option.key: option.comment for option in read(path).options if option.comment} | known
    return known


class OptionTables(SphinxDirective):
    """A section for each group, and one in it for each of its files."""

    def run(self) -> list[nodes.Node]:
        """Return the sections."""
        return [self.group(name, files) for name, files in groups()]

    def group(self, name: str, files: list[Path]) -> nodes.section:
        """Return the section of a group."""
        section = _section(TITLES.get(name, f"{name}="), f"group-{name}")
        known = known_comments([CONF / "base" / "protocol.yaml", *files] if name == "protocol" else files)
        for path in files:
            self.env.note_dependency(str(path))
            if name in ("base", "paths"):
                section += self.contents(path, known)
                continue
            title = f"hudepth-{path.stem}" if name == "Commands" else f"{name}={path.stem}"
            inner = _section(f"every {name}=" if path.stem == "base" else title, f"option-{name}-{path.stem}")
            inner += self.contents(path, known, whole=name in COMPOSITIONS)
            section += inner
        return section

    def contents(self, path: Path, known: dict[str, str], *, whole: bool = False) -> list[nodes.Node]:
        """Return what a file says: its first comment, and its keys or, ``whole``, itself."""
        if whole:
            text = "\n".join(
                line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("# @")
            )
            return [nodes.literal_block(text, text, language="yaml")]
        about, target, options = read(path)
        first, _, rest = about.partition("\n")
        result: list[nodes.Node] = [nodes.paragraph("", first)]
        if rest.strip():
            result.append(nodes.literal_block(rest, rest.strip("\n"), language="text"))
        if target.startswith("hudepth."):
            name = target.rpartition(".")[2]
            link = addnodes.pending_xref("", nodes.literal("", name), refdomain="py", reftype="class", reftarget=target)
            link["refdoc"], link["refexplicit"], link["refwarn"] = self.env.docname, True, True
            result.append(nodes.paragraph("", "Configures ", link, nodes.Text(".")))
        if options:
            described = [option._replace(comment=option.comment or known.get(option.key, "")) for option in options]
            result.append(_table(prefix(path), described))
        return result


def _section(title: str, name: str) -> nodes.section:
    return nodes.section("", nodes.title("", title), ids=[nodes.make_id(name)], names=[name])


def _table(start: str, options: list[Option]) -> nodes.table:
    rows = [
        _row(nodes.literal("", start + key), nodes.literal("", value) if value else nodes.Text(""), nodes.Text(comment))
        for key, value, comment in options
    ]
    head = nodes.thead("", _row(*(nodes.Text(word) for word in ("key", "value", "meaning"))))
    columns = [nodes.colspec(colwidth=width) for width in (30, 20, 50)]
    group = nodes.tgroup("", *columns, head, nodes.tbody("", *rows), cols=3)
    return nodes.table("", group, classes=["options"])


def _row(*cells: nodes.Node) -> nodes.row:
    return nodes.row("", *(nodes.entry("", nodes.paragraph("", "", cell)) for cell in cells))


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directive."""
    app.add_directive("option-tables", OptionTables)
    return {"parallel_read_safe": True}
