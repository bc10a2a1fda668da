"""Who may import whom: docs/design.md in code. Imports inside functions count; those for type checkers do, too."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "hudepth"
FILES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
LEVELS = (
    {"base"},
    {"models", "losses", "metrics", "cuda"},
    {"runs", "viz"},
    {"data"},
    {"training", "inference", "evaluation"},
    {"sweep", "export", "calibrate", "bench", "demo", "report"},
    {"cli", "help"},
)
"""From the bottom up: a package imports from levels below its own."""
SIDEWAYS = {("training", "evaluation"), ("bench", "export"), ("calibrate", "export"), ("cli", "help")}
"""The arrows within a level."""
HYDRA = ("cli", "base.wording", "base.options", "sweep.", "training.command")
"""Modules that may know Hydra and OmegaConf."""
LONGEST_CHAIN, MOST_FILES, MOST_LINES, LONGEST_FUNCTION = 8, 17, 250, 50


def imports(name: str) -> Iterator[str]:
    """Yield the dotted names that a file imports, wherever in it."""
    package = name if FILES[name].name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(FILES[name].read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*parts, *([node.module] if node.module else [])])
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def module_of(imported: str) -> str:
    """Return the file that a dotted name lies in; empty if it is not ours."""
    while imported and imported not in FILES:
        imported = imported.rpartition(".")[0]
    return imported


def room(name: str) -> str:
    return name.split(".")[1] if "." in name else ""


GRAPH = {name: {found for each in imports(name) if (found := module_of(each))} - {name, "hudepth"} for name in FILES}


def test_no_circle_of_files() -> None:
    try:
        TopologicalSorter(GRAPH).prepare()
    except CycleError as error:
        raise AssertionError(" -> ".join(error.args[1])) from None


def test_imports_point_down() -> None:
    level = {name: number for number, names in enumerate(LEVELS) for name in names}
    wrong = [
        f"{name} -> {other}"
        for name, others in GRAPH.items()
        for other in others
        if (room(name), room(other)) not in SIDEWAYS
        and room(name) != room(other)
        and level.get(room(name), len(LEVELS)) <= level[room(other)]
    ]
    assert not wrong, "\n".join(wrong)


def test_the_longest_chain_of_imports_between_folders() -> None:
    arrows: dict[str, set[str]] = {}
    for name, others in GRAPH.items():
        arrows.setdefault(room(name), set()).update(room(other) for other in others if room(other) != room(name))
    length: dict[str, int] = {}
    for each in TopologicalSorter(arrows).static_order():
        length[each] = 1 + max((length[other] for other in arrows[each]), default=0)
    assert max(length.values()) <= LONGEST_CHAIN


def test_hydra_stays_at_the_door() -> None:
    for name in FILES:
        if {each.partition(".")[0] for each in imports(name)} & {"hydra", "omegaconf"}:
            assert name.removeprefix("hudepth.").startswith(HYDRA), name


def test_nothing_imports_the_studies() -> None:
    for name in FILES:
        assert not any(each.startswith("experiments") for each in imports(name)), name


def test_files_and_functions_stay_small() -> None:
    folders: dict[Path, int] = {}
    for path in FILES.values():
        folders[path.parent] = folders.get(path.parent, 0) + 1
        text = path.read_text()
        assert text.count("\n") <= MOST_LINES, path
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert (node.end_lineno or 0) - node.lineno < LONGEST_FUNCTION, f"{path}: {node.name}"
    assert max(folders.values()) <= MOST_FILES
