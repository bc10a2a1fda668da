"""Synchronised raw frames of NYU Depth V2."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import ClassVar

from hudepth.data.encoding import check_encoding
from hudepth.data.sources.base import RawPair, Record, Source, existing_root
from hudepth.data.sources.files import inside, read_pair
from hudepth.data.sources.pairing import add_unique, category_of, pair_up, walk_files

_EXPECTS = "rgb_XXXXX.jpg with sync_depth_XXXXX.png"
_IMAGE = re.compile(r"rgb_([0-9]{1,9})\.(jpe?g|png)")
_DEPTH = re.compile(r"sync_depth_([0-9]{1,9})\.png")


class NyuRawSource(Source):
    """Raw NYU frames as BTS (Lee et al., 2019) and its successors train on them.

    ``rgb_XXXXX.jpg`` and ``sync_depth_XXXXX.png``, 640 x 480, 16-bit millimetres, 0 where the sensor saw
    nothing; either in the folder itself or in one folder per scene below it. Other files are left alone.

    Args:
        root: the folder.
        encoding: how depth values become metres.
    """

    name: ClassVar[str] = "nyu_raw"

    def __init__(self, root: str | Path | None, *, encoding: str = "uint16_mm") -> None:
        self.root = root
        self.encoding = encoding

    def records(self) -> Sequence[Record]:
        """List the pairs by scene and frame number. A scene is named by its folder.

        Raises:
            ConfigError: if the encoding is unknown.
            DataError: if there are no pairs, or a file has no partner.
        """
        check_encoding(self.encoding)
        root = existing_root(self.root, expects=f"folder with {_EXPECTS}")
        images: dict[str, str] = {}
        depths: dict[str, str] = {}
        for path in walk_files(root):
            scene = root.resolve().name if path.parent == PurePosixPath(".") else path.parent.as_posix()
            if image := _IMAGE.fullmatch(path.name):
                add_unique(images, f"{scene}/{image[1]}", str(path), what="image")
            elif depth := _DEPTH.fullmatch(path.name):
                add_unique(depths, f"{scene}/{depth[1]}", str(path), what="depth")
        return [
            _record(key, image, depth) for key, image, depth in pair_up(images, depths, root=root, expects=_EXPECTS)
        ]

    def read(self, record: Record) -> RawPair:
        """Decode one pair.

        Raises:
            DataError: if a file is missing, truncated, or the two differ in size.
        """
        root = existing_root(self.root, expects=f"folder with {_EXPECTS}")
        image, depth = (inside(root, name, where="data.root") for name in (record.image, record.depth))
        return read_pair(image, depth)

    def files(self) -> Sequence[Path]:
        """Return every image and depth map.

        Raises:
            DataError: as :meth:`records`.
        """
        records = self.records()
        root = existing_root(self.root, expects=f"folder with {_EXPECTS}")
        return [root / name for record in records for name in (record.image, record.depth)]


def _record(key: str, image: str, depth: str) -> Record:
    scene, number = key.rsplit("/", 1)
    return Record(id=key, scene=scene, frame=int(number), category=category_of(scene), image=image, depth=depth)
