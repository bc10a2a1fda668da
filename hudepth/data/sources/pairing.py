"""Pairs images with depth maps by name, for data sets that bring no list."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from hudepth.base.errors import DataError


def walk_files(root: Path) -> Iterator[PurePosixPath]:
    """Yield all files below ``root``, relative to it, in a stable order; linked folders are not followed."""
    for folder, folders, names in os.walk(root):
        folders.sort()
        inner = PurePosixPath(Path(folder).relative_to(root).as_posix())
        for name in sorted(names):
            yield inner / name


def add_unique(found: dict[str, str], key: str, path: str, *, what: str) -> None:
    """Note the file of a key.

    Raises:
        DataError: if the key has one already.
    """
    if key in found:
        raise DataError(f"'{found[key]}' and '{path}' are both the {what} of '{key}'. Keep one of them.")
    found[key] = path


def pair_up(
    images: Mapping[str, str], depths: Mapping[str, str], *, root: Path, expects: str
) -> list[tuple[str, str, str]]:
    """Return (key, image, depth) for each key, in natural order: ``frame_2`` comes before ``frame_10``.

    Args:
        images: path of each image by key.
        depths: path of each depth map by key.
        root: where they lie, for errors.
        expects: what names should look like, for errors.

    Raises:
        DataError: if there are none, or one has no partner.
    """
    if not images and not depths:
        raise DataError(f"data.root: no pairs in '{root}'. Expected {expects}.")
    if alone := sorted(images.keys() - depths.keys(), key=natural_key):
        raise DataError(
            f"data.root: {len(alone)} of {len(images)} images in '{root}' have no depth, "
            f"the first is '{images[alone[0]]}'. Expected {expects}."
        )
    if alone := sorted(depths.keys() - images.keys(), key=natural_key):
        raise DataError(
            f"data.root: {len(alone)} of {len(depths)} depth maps in '{root}' have no image, "
            f"the first is '{depths[alone[0]]}'. Expected {expects}."
        )
    return [(key, images[key], depths[key]) for key in sorted(images, key=natural_key)]


def natural_key(text: str) -> tuple[list[tuple[str, int]], str]:
    """Return a sorting key that compares the numbers within a name as numbers."""
    parts = re.findall(r"([^0-9]*)([0-9]*)", text)
    return [(word, int(digits or -1)) for word, digits in parts], text


def category_of(scene: str) -> str:
    """Return the kind of an NYU scene: its name without its number, ``kitchen`` for ``kitchen_0004``."""
    return re.sub(r"_\d{4}[a-z]?$", "", scene.rsplit("/", 1)[-1])
