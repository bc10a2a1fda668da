"""The --help of the console scripts: the comment on top of conf/<command>.yaml, then groups and shared options."""

from __future__ import annotations

from hudepth.base.verbs import conf_folder, options_of

SHARED_OPTIONS = """\
Options
  --cfg job         print the configuration and stop
  -m                multirun: comma-separated values become one run each
  debug=true        show the traceback of an error
  -sc install=bash  tab completion: eval "$(hudepth-train -sc install=bash)"; also zsh, fish"""


def help_text(command: str) -> str:
    """Return the help of ``hudepth-<command>``."""
    lines = (conf_folder() / f"{command}.yaml").read_text(encoding="utf-8").splitlines()
    comment = lines[: next(i for i, line in enumerate(lines) if not line.startswith("#"))]
    parts = ["\n".join(line.removeprefix("#").removeprefix(" ") for line in comment)]
    entries = [line[4:].partition(":")[0] for line in lines if line.startswith("  - ")]
    groups = [name for name in entries if name not in ("_self_", "hydra", "paths") and " " not in name]
    groups += ["experiment", "sweep"] if command == "train" else []  # no part of the defaults, but can be added
    if groups:
        listed = (f"  {group:<12}{', '.join(options_of(group))}" for group in groups)
        parts.append("\n".join(["Groups (choose with group=NAME)", *listed]))
    return "\n\n".join([*parts, SHARED_OPTIONS])
