"""Any images and depth maps, paired by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import ClassVar

from hudepth.base.errors import DataError
from hudepth.data.encoding import ENCODINGS, check_encoding
from hudepth.data.sources.base import RawPair, Record, Source, existing_root
from hudepth.data.sources.files import DEPTH_SUFFIXES, IMAGE_SUFFIXES, inside, read_pair
from hudepth.data.sources.pairing import add_unique, pair_up, walk_files


class FolderSource(Source):
    """Your own pairs: images and depth maps with equal names in two folders, or in one folder with suffixes.

    ``images/kitchen/01.jpg`` belongs to ``depths/kitchen/01.png``, and its scene is ``kitchen``. With both
    folders ``.``, ``image_suffix="_rgb"`` and ``depth_suffix="_depth"``, ``01_rgb.jpg`` belongs to
    ``01_depth.png``. Images are JPEG or PNG; depth maps are PNG of 8 or 16 bits, two-dimensional ``.npy``,
    or TIFF. Files of other kinds are left alone. Units are whatever ``encoding`` says: no file of this
    layout tells them.

    Args:
        root: the folder that holds both.
        images: folder of the images, relative to ``root``.
        depths: folder of the depth maps, likewise.
        image_suffix: end of an image's name, before its extension.
        depth_suffix: end of a depth map's name, likewise.
        encoding: how depth values become metres; required.
        indoor: whether the set shows rooms, for the check of its depth range.
    """

    name: ClassVar[str] = "folder"

    def __init__(
        self,
        root: str | Path | None,
        *,
        images: str = "images",
        depths: str = "depths",
        image_suffix: str = "",
        depth_suffix: str = "",
        encoding: str | None = None,
        indoor: bool = True,
    ) -> None:
        self.root = root
        self.images = images
        self.depths = depths
        self.image_suffix = image_suffix
        self.depth_suffix = depth_suffix
        self.encoding = encoding or ""
        self.indoor = indoor

    def records(self) -> Sequence[Record]:
        """List the pairs in natural order of their names.

        Raises:
            ConfigError: if the encoding is unknown.
            DataError: if no encoding is given, there are no pairs, or a file has no partner.
        """
        root = self._root()
        if not self.encoding:
            raise DataError(
                f"data.encoding is not set, and a folder does not tell its units. Choose one of {', '.join(ENCODINGS)}."
            )
        check_encoding(self.encoding)
        images, depths = self._named(root)
        expects = (
            f"'{self.images}/<name>{self.image_suffix}.jpg' "
            f"with '{self.depths}/<name>{self.depth_suffix}.png' (or .npy, .tif)"
        )
        frames: dict[str, int] = {}
        records = []
        for key, image, depth in pair_up(images, depths, root=root, expects=expects):
            scene = PurePosixPath(key).parent.as_posix().removeprefix(".")
            frames[scene] = frames.get(scene, -1) + 1
            records.append(Record(id=key, scene=scene, frame=frames[scene], image=image, depth=depth))
        return records

    def read(self, record: Record) -> RawPair:
        """Decode one pair.

        Raises:
            DataError: if a file is missing, truncated, or the two differ in size.
        """
        root = self._root()
        image, depth = (inside(root, name, where="data.root") for name in (record.image, record.depth))
        return read_pair(image, depth)

    def files(self) -> Sequence[Path]:
        """Return every image and depth map.

        Raises:
            DataError: as :meth:`records`.
        """
        root = self._root()
        return [root / name for record in self.records() for name in (record.image, record.depth)]

    def _root(self) -> Path:
        return existing_root(self.root, expects=f"folder with {self.images} and {self.depths}")

    def _named(self, root: Path) -> tuple[dict[str, str], dict[str, str]]:
        """Return the path of each image and of each depth map by the name they share."""
        shared = PurePosixPath(self.images) == PurePosixPath(self.depths)
        if shared and self.image_suffix == self.depth_suffix:
            raise DataError(
                f"data.source.images and data.source.depths are both '{self.images}', "
                "images and depth maps look alike. "
                "Pass data.source.image_suffix=_rgb data.source.depth_suffix=_depth, as your files are named."
            )
        images = self._keys(root, self.images, self.image_suffix, IMAGE_SUFFIXES, what="images")
        depths = self._keys(root, self.depths, self.depth_suffix, DEPTH_SUFFIXES, what="depths")
        if shared:  # where one suffix ends with the other, the longer one decides
            longer, shorter = (depths, images) if len(self.depth_suffix) > len(self.image_suffix) else (images, depths)
            taken = {path for _, path in longer}
            shorter[:] = [(key, path) for key, path in shorter if path not in taken]
        return _by_key(images, what="image"), _by_key(depths, what="depth")

    def _keys(
        self, root: Path, folder: str, suffix: str, extensions: Sequence[str], *, what: str
    ) -> list[tuple[str, str]]:
        base = inside(root, folder, where=f"data.source.{what}")
        if not base.is_dir():
            raise DataError(
                f"data.source.{what}: no folder '{folder}' in '{root}'. "
                f"Pass data.source.{what}=<folder within data.root>."
            )
        return [
            (str(path.with_suffix("")).removesuffix(suffix), str(PurePosixPath(folder) / path))
            for path in walk_files(base)
            if path.suffix.lower() in extensions and path.stem.endswith(suffix)
        ]


def _by_key(files: Sequence[tuple[str, str]], *, what: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for key, path in files:
        add_unique(found, key, path, what=what)
    return found
