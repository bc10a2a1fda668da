"""Files that appear whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from hudepth.base.errors import ConfigError

MAX_TEXT_BYTES = 1 << 28
"""Of a file of text: no run writes a larger one."""
_LEFTOVER = re.compile(r"\.(?:.*\.(\d+)\.part(?:\.mp4|\.webm)?|export-(\d+)-.*)")  # of the process with this id


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
        OSError: from the file system, with ``path`` as its file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        if durable:
            with part.open("rb") as file:
                os.fsync(file.fileno())  # else a power cut could leave the new name with an empty file behind it
        part.replace(path)
    except OSError as error:
        if error.filename in (None, str(part)):  # write() does not tell what it wrote to
            error.filename = str(path)
        raise
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


def read_text(path: Path, *, limit: int = MAX_TEXT_BYTES) -> str:
    """Read a regular file of UTF-8 of at most ``limit`` bytes: a link may lead to a device that never ends.

    Raises:
        OSError: from the file system, and for other files.
        UnicodeDecodeError: if it is not text.
    """
    if not stat.S_ISREG(path.stat().st_mode):  # before it is opened: a pipe would wait for its writer
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    with path.open("rb") as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise OSError(errno.EFBIG, f"larger than {limit >> 20} MiB", str(path))
    return content.decode("utf-8").replace("\r\n", "\n")


def read_json(path: Path) -> Any:
    """Read JSON.

    Raises:
        OSError: as :func:`read_text` does.
        ValueError: if it is not JSON, or nested too deep.
    """
    try:
        return json.loads(read_text(path))
    except RecursionError:
        raise ValueError("nested too deep") from None


def read_yaml(path: Path) -> Any:
    """Read plain YAML, with the fast parser where PyYAML was built with it.

    Raises:
        OSError: as :func:`read_text` does.
        UnicodeDecodeError: if it is not text.
        yaml.YAMLError: if it is not YAML, or larger or deeper than what a program writes.
    """
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    text = read_text(path, limit=MAX_TEXT_BYTES >> 4)
    depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):  # aliases multiply, and deep nesting ends the C parser
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > 50 or isinstance(event, yaml.AliasEvent):
                raise yaml.YAMLError("aliases, or nested too deep")
        return yaml.load(text, Loader=loader)
    except (ValueError, RecursionError, OverflowError) as error:  # a date of month 13, a number of 10,000 digits
        raise yaml.YAMLError(str(error)) from error


def name_results(files: Sequence[Path], root: Path) -> dict[Path, Path]:
    """Return for each file below ``root`` the relative path, without an ending, of what is made from it.

    Of two that differ only in the ending, it becomes part of the name: ``a_jpg`` and ``a_png``.
    """
    stems = {file: file.relative_to(root).with_suffix("") for file in files}
    times = Counter(stems.values())
    return {
        file: stem if times[stem] == 1 else stem.with_name(file.name.replace(".", "_")) for file, stem in stems.items()
    }


def remove_leftovers(folder: Path) -> None:
    """Remove the unfinished files of killed processes from a folder and those in it."""
    for path in (*folder.glob(".*"), *folder.glob("*/.*")):
        found = _LEFTOVER.fullmatch(path.name)
        if found and not path.is_symlink() and not _is_alive(int(found[1] or found[2])):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    if os.name == "nt":  # where signal 0 would end it
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # somebody else's
        return True
    return True


def output_folder(value: str | Path, *, key: str = "output", within: Path | None = None) -> Path:
    """Make a folder and try to write to it, before there is anything to lose; remove what killed processes left in it.

    Args:
        value: the folder.
        key: names it in errors.
        within: a folder that it must not leave through a link: a run directory may come from somebody else.

    Raises:
        ConfigError: if that is not possible.
    """
    output = Path(str(value)).expanduser()
    try:
        if within is not None:
            links = [output, *(output.iterdir() if output.is_dir() else ())]
            outside = [each for each in links if not each.resolve().is_relative_to(within.resolve())]
            if outside:
                fix = f"Remove the link, or pass {key}=<a folder>."
                raise ConfigError(f"{key}: '{outside[0]}' leads out of '{within}', to '{outside[0].resolve()}'. {fix}")
        output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=output):
            pass
        remove_leftovers(output)
        return output
    except OSError as error:
        raise ConfigError(f"{key}: cannot write to '{output}' ({error.strerror}). Pass {key}=<a folder>.") from error
