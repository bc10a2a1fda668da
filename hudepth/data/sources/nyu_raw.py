"""Synchronised raw frames of NYU Depth V2."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path, PurePosixPath
from typing import ClassVar

from hudepth.data.encoding import Encoding
from hudepth.data.sources import nyu
from hudepth.data.sources.base import Record, existing_root
from hudepth.data.sources.files import FileSource
from hudepth.data.sources.pairing import pair_up, printable, unique_keys, walk_files

_EXPECTS = "rgb_XXXXX.jpg with sync_depth_XXXXX.png"
_IMAGE = re.compile(r"rgb_([0-9]{1,9})\.(jpe?g|png)")
_DEPTH = re.compile(r"sync_depth_([0-9]{1,9})\.png")


@dataclass(eq=False)
class NyuRawSource(nyu.Nyu, FileSource):
    """Raw NYU frames as BTS (Lee et al., 2019) and its successors train on them.

    ``rgb_XXXXX.jpg`` and ``sync_depth_XXXXX.png``, 640 x 480, 16-bit millimetres, 0 where the sensor measured
    nothing; either in the folder ``root`` itself or in one folder per scene below it. Other files are ignored.
    """

    name: ClassVar[str] = "nyu_raw"

    root: str | Path | None
    _: KW_ONLY
    encoding: Encoding = "uint16_mm"

    def records(self) -> Sequence[Record]:
        """List the pairs by scene, which is named by its folder, and frame number; see :meth:`Source.records`."""
        root = self.folder()
        images, depths = [], []
        for path in walk_files(root):
            scene = root.resolve().name if path.parent == PurePosixPath(".") else printable(path.parent.as_posix())
            if image := _IMAGE.fullmatch(path.name):
                images.append((f"{scene}/{image[1]}", str(path)))
            elif depth := _DEPTH.fullmatch(path.name):
                depths.append((f"{scene}/{depth[1]}", str(path)))
        if self.unpaired:
            self.unpaired.clear()
        by_key = unique_keys(images, what="image"), unique_keys(depths, what="depth")
        return [_record(*pair) for pair in pair_up(*by_key, root=root, expects=_EXPECTS, unpaired=self.unpaired)]

    def folder(self) -> Path:
        """Return the root."""
        return existing_root(self.root, expects=f"folder with {_EXPECTS}")


def _record(key: str, image: str, depth: str) -> Record:
    scene, number = key.rsplit("/", 1)
    return Record(id=key, scene=scene, frame=int(number), category=nyu.category_of(scene), image=image, depth=depth)
