"""What the console scripts tell about themselves: ``--help``, from the comments in conf/, and tab completion."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator

from hudepth.base.console import wrap
from hudepth.base.verbs import SUBCOMMANDS, conf_folder, options_of

FLAGS = """\
Flags
  --cfg job         print the configuration with all keys and stop
  --info            print how it is composed, and stop
  -m                multirun: comma-separated values become one run each
  debug=true        show the traceback of an error
  -sc install=bash  tab completion: eval "$(hudepth-{command} -sc install=bash)"
                    in bash and zsh; for fish: -sc install=fish | source"""
_KEY = re.compile(r"(?P<indent> *)(?P<key>\w+): *(?P<value>(?:[^\s#]|(?<=\S) (?! *#)|(?<=\S)#)*) *(?:# (?P<about>.*))?")
_MARGIN = 22


def help_text(command: str) -> str:
    """Return the help of ``hudepth-<command>``, as wide as the terminal: examples, groups, and every key."""
    width = min(120, shutil.get_terminal_size().columns)
    lines = (conf_folder() / f"{command}.yaml").read_text(encoding="utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    comment = [line.removeprefix("#").removeprefix(" ") for line in lines[:start]]
    parts = ["\n".join(_example(line, width) for line in comment)]
    entries = [line[4:].partition(":")[0] for line in lines if line.startswith("  - ")]
    groups = [name for name in entries if name not in ("_self_", "hydra", "paths") and " " not in name]
    groups += ["experiment", "sweep"] if command == "train" else []  # no part of the defaults, but can be added
    if groups:
        listed = (_entry(group, ", ".join(options_of(group)), width) for group in groups)
        parts.append("\n".join(["Groups: group=NAME; --cfg job prints the keys of the chosen ones", *listed]))
    paths = (conf_folder() / "paths" / "default.yaml").read_text(encoding="utf-8").splitlines()[1:]  # without comment
    keys = [*_keys(lines[start:]), *((f"paths.{key}", about) for key, about in _keys(paths))]
    parts.append("\n".join(["Keys: key=value; here with their defaults", *(_entry(*key, width) for key in keys)]))
    return "\n\n".join([*parts, FLAGS.format(command=command)])


def _example(line: str, width: int) -> str:
    """Return a line of the comment; what does not fit goes below it."""
    found = re.fullmatch(r"(  hudepth-.*?\S)  +(\S.*)", line)
    if len(line) <= width or not found:
        return wrap(line, width)
    return f"{found[1]}\n{wrap(' ' * 6 + found[2], width, indent='')}"


def _entry(name: str, about: str, width: int) -> str:
    first = f"  {name:<{_MARGIN - 3}} " if len(name) < _MARGIN - 2 else f"  {name}\n{' ' * _MARGIN}"
    return first + wrap(" " * _MARGIN + about, width, indent="").lstrip()


def _keys(lines: list[str]) -> Iterator[tuple[str, str]]:
    """Yield ``key=default`` and the comment, beside or above it, of each key of a file."""
    above: list[str] = []
    parents: dict[int, str] = {}
    for line in lines:
        found = _KEY.fullmatch(line)
        if line.lstrip().startswith("# "):
            above.append(line.lstrip().removeprefix("# "))
        elif found and found["key"] not in ("defaults", "verb"):
            parents = {indent: key for indent, key in parents.items() if indent < len(found["indent"])}
            name = ".".join([*parents.values(), found["key"]])
            parents[len(found["indent"])] = found["key"]
            about = " ".join([*above, *filter(None, [found["about"]])])
            if found["value"]:
                yield f"{name}={'' if re.search(r'[?]{3}|[$]{', found['value']) else found['value']}", about
            above = []
        else:
            above = []


def complete(command: str) -> None:
    """Prepare the line that a shell asks to complete for Hydra, which knows groups and keys, but not words as ``info``.

    Words that may follow are printed. Of those before, only choices of groups stay: they decide which keys there are.
    """
    line = os.environ.get("COMP_LINE", "")[: int(os.environ.get("COMP_POINT", "0"))]
    script, *before, word = line.split(" ") if " " in line else [line, ""]
    verbs = SUBCOMMANDS.get(command, ())
    if "=" not in word and not set(verbs) & set(before):
        print(*(verb for verb in verbs if verb.startswith(word)))
    pairs = ((each, each.partition("=")[0].lstrip("+")) for each in before if not each.startswith("debug="))
    chosen = (each for each, group in pairs if group and (conf_folder() / group).is_dir())
    os.environ["COMP_LINE"] = " ".join([script, *chosen, word])
    os.environ["COMP_POINT"] = str(len(os.environ["COMP_LINE"]))
