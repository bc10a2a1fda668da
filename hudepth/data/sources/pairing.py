"""Pair images with depth maps by name, for data sets without a list."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath

from hudepth.base.console import log
from hudepth.base.errors import DataError


def walk_files(root: Path) -> Iterator[PurePosixPath]:
    """Yield all files below ``root``, relative to it, in a stable order; not those that systems hide in folders.

    Links to folders are followed; a folder reached twice, also in a circle, is listed once, with a warning.
    """
    seen = set()
    for folder, folders, names in os.walk(root, followlinks=True):
        inner = PurePosixPath(Path(folder).relative_to(root).as_posix())
        real = os.path.realpath(folder)
        if real in seen:
            log.warning("'%s' is a link to a folder that is listed already: left out", folder)
            folders.clear()
            continue
        seen.add(real)
        folders.sort()
        yield from (inner / name for name in sorted(names) if not name.startswith("._"))


def printable(name: str) -> str:
    """Return a file name as text: bytes that are not UTF-8 are escaped, as ``\\xe9``."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def unique_keys(files: Iterable[tuple[str, str]], *, what: str) -> dict[str, str]:
    """Return the path of each key, of (key, path) pairs; DataError if two files have the same key."""
    found: dict[str, str] = {}
    for key, path in files:
        if key in found:
            raise DataError(f"'{found[key]}' and '{path}' are both the {what} of '{key}'. Keep one of them.")
        found[key] = path
    return found


def pair_up(
    images: Mapping[str, str], depths: Mapping[str, str], *, root: Path, expects: str, unpaired: list[str] | None = None
) -> list[tuple[str, str, str]]:
    """Return (key, image, depth) for each key of both, in natural order: ``frame_2`` comes before ``frame_10``.

    Raises DataError, with their folder ``root`` and the names it ``expects``, if there are none or one has no partner;
    if there is a list ``unpaired``, files without partner are added to it instead.
    """
    if not images and not depths:
        raise DataError(f"data.root: no pairs in '{root}'. Expected {expects}.")
    both = images.keys() & depths.keys()
    for here, there, what, partner in ((images, depths, "images", "depth"), (depths, images, "depth maps", "image")):
        alone = sorted(here.keys() - there.keys(), key=natural_key)
        if alone and (unpaired is None or not both):
            skip = " Pass data.on_error=skip to leave them out." if both else ""
            raise DataError(
                f"data.root: {len(alone)} of {len(here)} {what} in '{root}' have no {partner}, "
                f"the first is '{here[alone[0]]}'. Expected {expects}.{skip}"
            )
        if unpaired is not None:
            unpaired += [f"'{here[key]}': has no {partner}." for key in alone]
    return [(key, images[key], depths[key]) for key in sorted(both, key=natural_key)]


def natural_key(text: str) -> tuple[list[tuple[str, int]], str]:
    """Return a sorting key that compares the numbers within a name as numbers."""
    parts = re.findall(r"([^0-9]*)([0-9]*)", text)
    return [(word, int(digits or -1)) for word, digits in parts], text
