"""Find the inputs that ``input=`` names: an image, a folder, a pattern, a video, or the number of a camera."""

from __future__ import annotations

import glob
import itertools
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from hudepth.base.errors import DataError
from hudepth.base.images import SUFFIXES

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")


class Item(NamedTuple):
    """A file to predict, and the name of its results."""

    path: Path
    stem: Path  # relative to the output folder, without an ending


class Inputs(NamedTuple):
    """What to predict."""

    images: list[Item]
    videos: list[Item]
    camera: int | None = None


def find_inputs(spec: str, *, recursive: bool) -> Inputs:
    """Return the files or camera that ``spec`` names, sorted; raises DataError if there is nothing to predict.

    ``spec`` is a file, a folder, a pattern with ``*``, ``?`` or ``**``, or the number of a camera; ``recursive``
    searches subfolders, whose names are kept in the results.
    """
    if spec.isdecimal() and not Path(spec).exists():
        return Inputs([], [], camera=int(spec))
    path = Path(spec).expanduser()
    if path.is_dir():
        root, files = path, sorted(path.rglob("*") if recursive else path.iterdir())
    elif path.is_file():
        root, files = path.parent, [path]
    else:
        root = Path(*itertools.takewhile(lambda part: not glob.has_magic(part), path.parts[:-1]))
        files = sorted(root.glob(str(path.relative_to(root)))) if glob.has_magic(str(path)) else []
        if not files:
            wanted = "an image, folder, 'pattern', video or camera"
            raise DataError(f"input: no file, folder or match '{spec}'. Pass {wanted}.")
    files = [file for file in files if file.is_file() and not file.name.startswith(".")]
    videos = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES]
    alone = path.is_file()  # a file that is named is read, whatever its ending
    images = [f for f in files if f not in videos and (alone or f.suffix.lower() in SUFFIXES)]
    if not images and not videos:
        below = "" if recursive else " Pass recursive=true to search subfolders."
        raise DataError(f"input: no image or video in '{spec}' ({', '.join(SUFFIXES + VIDEO_SUFFIXES)}).{below}")
    stems = {file: file.relative_to(root).with_suffix("") for file in images + videos}
    times = Counter(stems.values())
    for file, stem in stems.items():
        if times[stem] > 1:  # two that differ only in the ending, which becomes part of the name
            stems[file] = stem.with_name(file.name.replace(".", "_"))
    return Inputs([Item(file, stems[file]) for file in images], [Item(file, stems[file]) for file in videos])
