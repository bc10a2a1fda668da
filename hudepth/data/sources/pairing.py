"""Pair images with depth maps by name, for data sets without a list."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath

from hudepth.base.errors import DataError


def walk_files(root: Path) -> Iterator[PurePosixPath]:
    """Yield all files below ``root``, relative to it, in a stable order; linked folders are not followed."""
    for folder, folders, names in os.walk(root):
        folders.sort()
        inner = PurePosixPath(Path(folder).relative_to(root).as_posix())
        yield from (inner / name for name in sorted(names))


def unique_keys(files: Iterable[tuple[str, str]], *, what: str) -> dict[str, str]:
    """Return the path of each key, of (key, path) pairs; DataError if two files have the same key."""
    found: dict[str, str] = {}
    for key, path in files:
        if key in found:
            raise DataError(f"'{found[key]}' and '{path}' are both the {what} of '{key}'. Keep one of them.")
        found[key] = path
    return found


def pair_up(
    images: Mapping[str, str], depths: Mapping[str, str], *, root: Path, expects: str
) -> list[tuple[str, str, str]]:
    """Return (key, image, depth) for each key of both, in natural order: ``frame_2`` comes before ``frame_10``.

    Raises DataError, with their folder ``root`` and the names it ``expects``, if there are none or one has no partner.
    """
    if not images and not depths:
        raise DataError(f"data.root: no pairs in '{root}'. Expected {expects}.")
    for here, there, what, partner in ((images, depths, "images", "depth"), (depths, images, "depth maps", "image")):
        if alone := sorted(here.keys() - there.keys(), key=natural_key):
            raise DataError(
                f"data.root: {len(alone)} of {len(here)} {what} in '{root}' have no {partner}, "
                f"the first is '{here[alone[0]]}'. Expected {expects}."
            )
    return [(key, images[key], depths[key]) for key in sorted(images, key=natural_key)]


def natural_key(text: str) -> tuple[list[tuple[str, int]], str]:
    """Return a sorting key that compares the numbers within a name as numbers."""
    parts = re.findall(r"([^0-9]*)([0-9]*)", text)
    return [(word, int(digits or -1)) for word, digits in parts], text
