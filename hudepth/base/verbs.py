"""The console scripts, their subcommands, and the configuration tree they read."""

from __future__ import annotations

from pathlib import Path

SUBCOMMANDS = {
    "data": ("prepare", "info", "audit", "download", "calibrate"),
    "report": ("compare", "table", "sweep", "figures"),
}
"""The first word after the console scripts that can do several things."""
OWN_COMMAND = {("data", "calibrate")}
"""Verbs that need more than their script's command may import: they run the function of their own name."""


def shipped(inside: str, beside: str) -> Path:
    """Return a folder that an installed wheel has inside the package, and the repository beside it."""
    package = Path(__file__).parents[1]
    return folder if (folder := package / inside).is_dir() else package.parent / beside


def conf_folder() -> Path:
    """Return the folder of the configuration tree."""
    return shipped("conf", "conf")


def options_of(group: str) -> list[str]:
    """Return the choices of a group of the configuration, for example ``data``."""
    return sorted(path.stem for path in (conf_folder() / group).glob("*.yaml") if path.stem != "base")


def commands() -> list[str]:
    """Return the commands: each has a configuration at the top of the tree."""
    return sorted(path.stem for path in conf_folder().glob("*.yaml"))


def module_of(command: str) -> str:
    """Return the module behind ``hudepth-<command>``: the ``command.py`` with a function of that name.

    Its text is searched, since importing it takes seconds.
    """
    paths = sorted(Path(__file__).parents[1].glob("*/command.py"))
    found = next(path for path in paths if f"\ndef {command}(" in path.read_text(encoding="utf-8"))
    return f"hudepth.{found.parent.name}.command"
