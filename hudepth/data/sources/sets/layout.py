"""What public data sets share: pairs found by the names of their files, lists of a split, masks."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path, PurePosixPath
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hudepth.base.console import log
from hudepth.base.errors import DataError
from hudepth.base.images import read_bytes
from hudepth.data.encoding import Encoding
from hudepth.data.sources.arrays import read_npy
from hudepth.data.sources.base import RawPair, Record, existing_root
from hudepth.data.sources.decoding import read_depth
from hudepth.data.sources.files import FileSource, inside
from hudepth.data.sources.pairing import pair_up, unique_keys, walk_files


@dataclass(eq=False)
class SetSource(FileSource):
    """A set whose pairs are known by the names of their files below ``root``.

    ``train_list`` and ``test_list`` are text files, relative to ``root`` or absolute, with a line for each pair or
    scene: then only these pairs are read, and they are the official split. They must not have pairs in common.
    """

    root: str | Path | None
    _: KW_ONLY
    encoding: Encoding = "auto"
    train_list: str | None = None
    test_list: str | None = None

    image_name: ClassVar[re.Pattern[str]]
    depth_name: ClassVar[re.Pattern[str]]
    """Of the whole path below the root; ``(?P<split>)``, if there, is ``train`` or ``test``."""
    key: ClassVar[str]
    """Template of a pair's id, from the groups of both patterns."""
    scene: ClassVar[str]
    """Template of its scene, from the groups of the image's."""
    expects: ClassVar[str]
    """What the root holds, for errors."""
    _told = False
    spare_images: ClassVar[bool] = False
    """Whether the set has images without depth, which are left out."""

    def records(self) -> Sequence[Record]:
        """List the pairs in natural order of their ids; see :meth:`Source.records`."""
        root = self.folder()
        if self.unpaired:
            self.unpaired.clear()
        entries = self._entries(root)
        paths = [path.as_posix() for path in walk_files(root)]
        depths, images = (self._found(paths, entries, what=what) for what in ("depth", "image"))
        if self.spare_images:
            images = {key: path for key, path in images.items() if key in depths}
        self._tell_lost(entries, depths.keys() & images.keys(), root)
        pairs = pair_up(images, depths, root=root, expects=self.expects, unpaired=self.unpaired)
        frames: dict[str, int] = {}
        return [self._record(*pair, entries, frames) for pair in pairs]

    def folder(self) -> Path:
        """Return the root."""
        return existing_root(self.root, expects=f"folder with {self.expects}")

    def lines(self, root: Path, name: str | None, *, split: str) -> Iterator[tuple[int, str]]:
        """Yield number and text of each line of a list; see :func:`read_list`."""
        return read_list(root, name, key=f"data.source.{split}_list")

    def entry(self, line: str) -> str | None:
        """Return the id or scene that a line of a list names; None if it names none."""
        return line

    def masks(self, record: Record) -> Sequence[str]:
        """Return the masks of a pair, relative to the root: where one is 0, nothing is measured."""
        return ()

    def read(self, record: Record) -> RawPair:
        """Decode a pair and its masks; see :meth:`Source.read`."""
        pair = super().read(record)
        for name in self.masks(record):
            pair = masked(pair, inside(self.folder(), name, where="data.root"))
        return pair

    def files(self) -> Sequence[Path]:
        """Return every image, depth map and mask."""
        folder = self.folder()
        return [folder / name for each in self.records() for name in (each.image, each.depth, *self.masks(each))]

    def _found(self, paths: Sequence[str], entries: Mapping[str, str], *, what: str) -> dict[str, str]:
        """Return the path of each pair's image or depth by its id; of those on the lists, if there are any."""
        pattern = self.image_name if what == "image" else self.depth_name
        found = ((match.expand(self.key), path) for path in paths if (match := pattern.fullmatch(path)))
        return unique_keys(((k, path) for k, path in found if not entries or _entry_of(k, entries)), what=what)

    def _record(self, key: str, image: str, depth: str, entries: Mapping[str, str], frames: dict[str, int]) -> Record:
        of_image, of_depth = self.image_name.fullmatch(image), self.depth_name.fullmatch(depth)
        assert of_image
        assert of_depth
        scene, named = of_image.expand(self.scene), of_depth.groupdict()
        frames[scene] = frames.get(scene, -1) + 1
        split = entries.get(_entry_of(key, entries), (named["split"] or "test") if "split" in named else "")
        return Record(id=key, scene=scene, frame=frames[scene], split=split, image=image, depth=depth)

    def _tell_lost(self, entries: Mapping[str, str], keys: Collection[str], root: Path) -> None:
        """Warn, once, of entries of the lists that have no pair; DataError if none has one."""
        lost = sorted(entries.keys() - {_entry_of(key, entries) for key in keys})
        if lost and len(lost) == len(entries):
            raise DataError(f"data.root: '{root}' has no pair of those on the lists, the first is '{lost[0]}'.")
        if lost and not self._told:
            self._told = True
            text = "%d of %d entries of the lists have no image or no depth in '%s': left out, the first is '%s'"
            log.warning(text, len(lost), len(entries), root, lost[0])

    def _entries(self, root: Path) -> dict[str, str]:
        """Return the split of each entry of the lists."""
        found: dict[str, str] = {}
        for split, name in (("train", self.train_list), ("test", self.test_list)):
            for number, line in self.lines(root, name, split=split):
                entry = self.entry(line)
                if entry is None:
                    why = f"line {number} of '{name}' names no pair of {self.name}"
                    raise DataError(f"data.source.{split}_list: {why}. Pass a list of the set.")
                if found.setdefault(entry, split) != split:
                    raise DataError(f"data.source.test_list: '{entry}' is in both lists. Keep it in one.")
        return found


def read_list(root: Path, name: str | None, *, key: str) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line of a list that is neither blank nor a comment; DataError if it is missing."""
    if not name:
        return
    path = root / Path(name).expanduser()  # an absolute name stays as it is
    if not path.is_file():
        raise DataError(f"{key}: no file '{path}'. Pass {key}=<text file with a line for each pair>.")
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DataError(f"{key}: '{path}' is not a text file.") from None
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.strip()


def _entry_of(key: str, entries: Mapping[str, str]) -> str:
    """Return the entry that names a pair, by its id or by its scene, which is its folder; empty if none does."""
    return next((name for name in (key, key.rpartition("/")[0]) if name in entries), "")


def masked(pair: RawPair, path: Path) -> RawPair:
    """Return a pair with depth 0 where a mask is 0; DataError if it cannot be read or is of another size."""
    mask: NDArray[np.generic]
    mask = read_npy(path, f"'{path}'", kinds="uifb") if path.suffix == ".npy" else read_depth(path, mask=True)
    if mask.shape != pair.depth.shape:
        raise DataError(f"'{path}': a mask of {mask.shape} for depth of {pair.depth.shape}. Copy both again.")
    return RawPair(pair.image, np.where(mask != 0, pair.depth, pair.depth.dtype.type(0)))


def with_stem(name: str, folder: str, ending: str) -> str:
    """Return the path of a file next to ``name``: in ``folder`` instead of its own, with another ending."""
    path = PurePosixPath(name)
    return (path.parent.parent / folder / f"{path.stem}{ending}").as_posix()
