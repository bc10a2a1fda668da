"""Find the inputs that ``input=`` names: an image, a folder, a pattern, a video, or the number of a camera."""

from __future__ import annotations

import glob
import itertools
import re
from pathlib import Path
from typing import NamedTuple

from hudepth.base.errors import DataError
from hudepth.base.files import name_results
from hudepth.base.images import SUFFIXES

VIDEO_SUFFIXES = (
    ".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp", ".wmv",
)  # fmt: skip
UNREAD_SUFFIXES = (".jxl", ".jp2", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf")
"""Photographs that are not decoded here: they are tried, so that each is listed with the reason."""
_RESULT = re.compile(r".+_(depth|side)\.(png|jpg|mp4|webm)")  # as inference/depth_files.py names pictures


class Item(NamedTuple):
    """A file to predict, and the name of its results."""

    path: Path
    stem: Path  # relative to the output folder, without an ending


class Inputs(NamedTuple):
    """What to predict."""

    images: list[Item]
    videos: list[Item]
    camera: int | None = None
    left_out: tuple[str, ...] = ()
    """Lines that count and name files of a folder that are no inputs."""


def find_inputs(spec: str, *, recursive: bool, output: Path | None = None) -> Inputs:
    """Return the files or camera that ``spec`` names, sorted; raises DataError if there is nothing to predict.

    ``spec`` is a file, a folder, a pattern with ``*``, ``?`` or ``**``, or the number of a camera; ``recursive``
    searches subfolders, whose names are kept in the results. Files below ``output`` and results of earlier runs are
    left out.
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
    folders = [] if recursive else [f for f in files if f.is_dir() and f.name[0] != "." and not _is_same(f, output)]
    hidden = [f for f in files if f.name.startswith(".") and f.suffix.lower() in (*SUFFIXES, *VIDEO_SUFFIXES)]
    files = [file for file in files if file.is_file() and not file.name.startswith(".")]
    alone = path.is_file()  # a file that is named is read, whatever its ending
    results = [] if alone else [file for file in files if _is_result(file, root, output)]
    files = [file for file in files if file not in set(results)]
    videos = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES]
    images = [f for f in files if f not in videos and (alone or _is_photo(f))]
    others = [file for file in files if file not in {*images, *videos}]
    reasons = {
        "results of hudepth-predict": results, "neither image nor video": others, "hidden": hidden,
        "subfolders, which recursive=true searches": folders,
    }  # fmt: skip
    left_out = [f"left out, {what}: {_names(found)}" for what, found in reasons.items() if found]
    if not images and not videos:
        below = "" if recursive else " Pass recursive=true to search subfolders."
        raise DataError(f"input: no image or video in '{spec}' ({', '.join(SUFFIXES + VIDEO_SUFFIXES)}).{below}")
    stems = name_results(images + videos, root)
    photos, films = ([Item(file, stems[file]) for file in found] for found in (images, videos))
    return Inputs(photos, films, left_out=tuple(left_out))


def _is_same(folder: Path, output: Path | None) -> bool:
    return output is not None and folder.resolve() == output.resolve()


def _is_result(file: Path, root: Path, output: Path | None) -> bool:
    """Whether a file is below the output folder, or has the name of a result where a prediction was recorded."""
    if output is not None and output.resolve() in file.resolve().parents and root.resolve() in output.resolve().parents:
        return True
    above = itertools.takewhile(lambda folder: folder != root.parent, file.parents)
    return bool(_RESULT.fullmatch(file.name)) and any((folder / "predictions.json").is_file() for folder in above)


def _is_photo(file: Path) -> bool:
    suffix = file.suffix.lower()
    return suffix in (*SUFFIXES, *UNREAD_SUFFIXES) or (not suffix and _is_image(file))


def _is_image(path: Path) -> bool:
    """Return whether a file begins as an image does; False if it cannot be read."""
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError:
        return False
    return (
        head.startswith((b"\xff\xd8\xff", b"\x89PNG", b"GIF8", b"II*\0", b"MM\0*"))
        or head[4:8] == b"ftyp"
        or (head[:4] == b"RIFF" and head[8:12] == b"WEBP")
    )


def _names(files: list[Path]) -> str:
    shown = ", ".join(file.name for file in files[:5])
    return f"{len(files)} ({shown}{', ...' if len(files) > 5 else ''})"
