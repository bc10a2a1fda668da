"""Files that appear whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from hudepth.base.errors import ConfigError


@contextmanager
def written_whole(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path next to ``path`` to write to; rename it to ``path`` only if the block succeeds.

    Whatever happens in between (an exception, a full disk, a kill), an existing ``path`` stays as it was. After a
    kill the unfinished file remains under a name that starts with a dot and ends in ``.part``.

    Args:
        path: the file to appear; its folder is made.
        durable: flush to disk first, so that the file also survives a power cut; not worth the wait for thousands of
            files that can be made again.

    Raises:
        OSError: from the file system.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        if durable:
            with part.open("rb") as file:
                os.fsync(file.fileno())  # else a power cut could leave the new name with an empty file behind it
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path``, whole or not at all."""
    with written_whole(path) as part:
        part.write_text(text, encoding="utf-8")


def write_between(path: Path, marker: str, text: str) -> None:
    """Replace what a UTF-8 file holds between two lines ``<!-- marker -->``: for tables that programs write.

    Raises:
        ValueError: if there are not two such lines.
    """
    line = f"<!-- {marker} -->\n"
    parts = path.read_text(encoding="utf-8").split(line)
    if len(parts) != 3:
        raise ValueError(f"'{path}' needs two lines '{line.strip()}' and has {len(parts) - 1}.")
    write_text(path, line.join([parts[0], f"{text.strip()}\n", parts[2]]))


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, whole or not at all.

    Raises:
        ValueError: if it holds NaN or infinity, which JSON cannot express.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_yaml(path: Path) -> Any:
    """Read plain YAML, with the fast parser where PyYAML was built with it.

    Raises:
        OSError: from the file system.
        UnicodeDecodeError: if it is not text.
        yaml.YAMLError: if it is not YAML.
    """
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return yaml.load(path.read_text(encoding="utf-8"), Loader=loader)


def output_folder(value: str | Path, *, key: str = "output") -> Path:
    """Make a folder and try to write to it, before there is anything to lose.

    Raises:
        ConfigError: if that is not possible.
    """
    output = Path(str(value)).expanduser()
    try:
        output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=output):
            return output
    except OSError as error:
        raise ConfigError(f"{key}: cannot write to '{output}' ({error.strerror}). Pass {key}=<a folder>.") from error
