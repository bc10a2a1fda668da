"""The console scripts, their subcommands, and the configuration tree they read."""

from __future__ import annotations

from pathlib import Path

COMMANDS = {
    "train": "training", "test": "evaluation", "data": "data", "report": "report", "predict": "inference",
    "export": "export", "bench": "bench", "demo": "demo",
}  # fmt: skip
"""The package behind each console script; its ``command.py`` holds a function of the script's name."""


VERBS = {"data": ("prepare", "info", "audit"), "report": ("compare", "table", "sweep", "figures")}
"""The first word after the console scripts that can do several things."""


def conf_folder() -> Path:
    """Return the folder of the configuration tree."""
    import hudepth.conf

    return Path(str(hudepth.conf.__file__)).parent


def options_of(group: str) -> list[str]:
    """Return the choices of a group of the configuration, for example ``data``."""
    return sorted(path.stem for path in (conf_folder() / group).glob("*.yaml") if path.stem != "base")
