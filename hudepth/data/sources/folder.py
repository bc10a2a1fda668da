"""Any images and depth maps, paired by name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path, PurePosixPath
from typing import ClassVar
from unicodedata import normalize

from hudepth.base.camera import CameraOption
from hudepth.base.errors import DataError
from hudepth.data.encoding import ENCODINGS, Encoding
from hudepth.data.sources.base import Record, existing_root
from hudepth.data.sources.files import DEPTH_SUFFIXES, IMAGE_SUFFIXES, OTHER_DEPTH_SUFFIXES, FileSource, inside
from hudepth.data.sources.pairing import pair_up, printable, unique_keys, walk_files

_IMAGE_WORDS, _DEPTH_WORDS = (
    re.compile(rf"(.*/|)(?:(?:{words})(?:[_-]|(?=\d))(.+)|(.+)[_-](?:{words}))", re.IGNORECASE)
    for words in ("rgb|colou?r|image|img", "sync_depth|depth|disparity|disp")
)
"""Names that begin or end with a word for what the file is."""


@dataclass(eq=False)
class FolderSource(FileSource):
    """Your own pairs: images and depth maps with equal names in two folders, or in one folder with suffixes.

    ``images/kitchen/01.jpg`` belongs to ``depths/kitchen/01.png``, and its scene is ``kitchen``. With both
    folders ``.``, ``image_suffix="_rgb"`` and ``depth_suffix="_depth"``, ``01_rgb.jpg`` belongs to
    ``01_depth.png``. Where no names are equal, words that only say what a file is are left out: ``rgb_01.jpg`` belongs
    to ``depth_01.png``, in one folder as in two. Images are JPEG or PNG; depth maps are PNG of 8 or 16 bits, ``.npy``,
    TIFF or PFM. Files of other kinds are ignored.

    ``images`` and ``depths`` are relative to ``root``; suffixes end a name before its extension. ``encoding`` is
    required, since the files do not state it.
    """

    name: ClassVar[str] = "folder"
    upright: ClassVar[bool] = True

    root: str | Path | None
    _: KW_ONLY
    images: str = "images"
    depths: str = "depths"
    image_suffix: str = ""
    depth_suffix: str = ""
    encoding: Encoding | None = None  # type: ignore[assignment]  # checked by records()
    indoor: bool = True
    farthest_m: float | None = None
    sparse: bool = False
    camera: CameraOption | None = None
    unequal_sizes: bool = False

    def records(self) -> Sequence[Record]:
        """List the pairs in natural order of their names; see :meth:`Source.records`."""
        root = self.folder()
        if not self.encoding:
            raise DataError(
                f"data.encoding is not set, and a folder does not state its unit. Pass one of {', '.join(ENCODINGS)}."
            )
        images, depths = self._find(root)
        if self.unpaired:
            self.unpaired.clear()
        expects = f"'{self.images}/<name>{self.image_suffix}.jpg' with '{self.depths}/<name>{self.depth_suffix}.png'"
        frames: dict[str, int] = {}
        records = []
        expects += " (or .npy, .tif), or 'rgb_<name>' with 'depth_<name>'; data=manifest reads a list of other names"
        for key, image, depth in pair_up(images, depths, root=root, expects=expects, unpaired=self.unpaired):
            scene = PurePosixPath(key).parent.as_posix().removeprefix(".")
            frames[scene] = frames.get(scene, -1) + 1
            records.append(Record(id=key, scene=scene, frame=frames[scene], image=image, depth=depth))
        return records

    def folder(self) -> Path:
        """Return the root."""
        return existing_root(self.root, expects=f"folder with {self.images} and {self.depths}")

    def _find(self, root: Path) -> tuple[dict[str, str], dict[str, str]]:
        """Return the path of each image and of each depth map by their common name."""
        shared = PurePosixPath(self.images) == PurePosixPath(self.depths)
        images = self._list(root, self.images, self.image_suffix, IMAGE_SUFFIXES, what="images")
        depths = self._list(root, self.depths, self.depth_suffix, DEPTH_SUFFIXES, what="depths")
        if shared and self.image_suffix == self.depth_suffix:
            images, depths = _without_words(images, _IMAGE_WORDS), _without_words(depths, _DEPTH_WORDS)
            if images and depths:
                return unique_keys(images, what="image"), unique_keys(depths, what="depth")
            raise DataError(
                f"data.source.images and data.source.depths are both '{self.images}', so images and depth maps cannot "
                "be told apart. Pass data.source.image_suffix=_rgb data.source.depth_suffix=_depth, as they are named, "
                "or list the pairs for data=manifest."
            )
        if not depths and not shared:
            depths = self._list(root, self.depths, self.depth_suffix, OTHER_DEPTH_SUFFIXES, what="depths")
        if shared:  # where one suffix ends with the other, the longer one decides
            longer, shorter = (depths, images) if len(self.depth_suffix) > len(self.image_suffix) else (images, depths)
            taken = {path for _, path in longer}
            shorter[:] = [(key, path) for key, path in shorter if path not in taken]
        if not {key for key, _ in images} & {key for key, _ in depths}:
            named = [
                [*_without_words(files, words), *(file for file in files if not words.fullmatch(file[0]))]
                for files, words in ((images, _IMAGE_WORDS), (depths, _DEPTH_WORDS))
            ]
            if {key for key, _ in named[0]} & {key for key, _ in named[1]}:
                images, depths = named
        return unique_keys(images, what="image"), unique_keys(depths, what="depth")

    def _list(
        self, root: Path, folder: str, suffix: str, extensions: Sequence[str], *, what: str
    ) -> list[tuple[str, str]]:
        """Return (key, path) of the files of one kind."""
        base = inside(root, folder, where=f"data.source.{what}")
        if not base.is_dir():
            raise DataError(
                f"data.source.{what}: no folder '{folder}' in '{root}'. "
                f"Pass data.source.{what}=<folder within data.root>."
            )
        return [
            # Macs write accents as letters of their own, which are the same name.
            (
                normalize("NFC", printable(str(path.with_suffix("")).removesuffix(suffix))),
                str(PurePosixPath(folder) / path),
            )
            for path in walk_files(base)
            if path.suffix.lower() in extensions and path.stem.endswith(suffix)
        ]


def _without_words(files: Sequence[tuple[str, str]], words: re.Pattern[str]) -> list[tuple[str, str]]:
    """Return (key, path) of the files whose names have such a word, without it."""
    found = ((words.fullmatch(key), path) for key, path in files)
    return [(f"{match[1]}{match[2] or match[3]}", path) for match, path in found if match]
