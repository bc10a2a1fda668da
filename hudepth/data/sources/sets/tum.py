"""TUM RGB-D: sequences whose images and depth maps are taken at different times."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from hudepth.base.errors import DataError
from hudepth.base.options import Range
from hudepth.data.encoding import Encoding
from hudepth.data.sources.base import Record, existing_root
from hudepth.data.sources.files import FileSource, inside
from hudepth.data.sources.sets.layout import read_list

_LISTS = ("rgb.txt", "depth.txt")


@dataclass(eq=False)
class TumSource(FileSource):
    """TUM RGB-D (Sturm et al., IROS 2012): ``rgb.txt`` and ``depth.txt`` list files by the time they were taken.

    Each image is joined with the depth map nearest in time, at most ``max_difference_s`` away, as the set's
    ``associate.py`` does. ``root`` is a sequence or a folder of them. Depth is 16-bit PNG in 1/5000 m. ``every``: take
    each such pair only, since neighbours are alike.
    """

    name: ClassVar[str] = "tum"
    homepage: ClassVar[str] = "https://cvg.cit.tum.de/data/datasets/rgbd-dataset"
    licence: ClassVar[str] = "cc-by-4.0"
    terms: ClassVar[str] = (
        "TUM RGB-D (Sturm, Engelhard, Endres, Burgard, Cremers, IROS 2012), published under CC BY 4.0."
    )
    usual_median_m = (0.4, 6.0)

    root: str | Path | None
    _: KW_ONLY
    encoding: Encoding = "uint16_5000"
    max_difference_s: Annotated[float, Range(0)] = 0.02
    every: Annotated[int, Range(1)] = 1

    def records(self) -> Sequence[Record]:
        """List the pairs of each sequence in time; see :meth:`Source.records`."""
        root = self.folder()
        places = sorted(path.parent for pattern in ("", "*/", "*/*/") for path in root.glob(f"{pattern}{_LISTS[0]}"))
        if not places:
            raise DataError(f"data.root: no {_LISTS[0]} in '{root}' or two levels below. Unpack a sequence there.")
        return [record for place in places for record in self._sequence(root, place)]

    def folder(self) -> Path:
        """Return the root."""
        return existing_root(self.root, expects="a sequence with rgb.txt and depth.txt, or the folder of several")

    def _sequence(self, root: Path, place: Path) -> list[Record]:
        images, depths = (_stamped(place, name) for name in _LISTS)
        scene, prefix = place.resolve().name, place.relative_to(root).as_posix()
        pairs = associate([time for time, _ in images], [time for time, _ in depths], most_s=self.max_difference_s)
        if not pairs:
            why = f"no image is within {self.max_difference_s:g} s of a depth map"
            raise DataError(f"'{place}': {why}. Pass data.source.max_difference_s=<seconds>.")
        records = []
        for frame, (i, j) in enumerate(pairs[:: self.every]):
            (image, depth) = (f"{prefix}/{name}".removeprefix("./") for name in (images[i][1], depths[j][1]))
            records.append(Record(id=f"{scene}/{Path(image).stem}", scene=scene, frame=frame, image=image, depth=depth))
        return records


def _stamped(place: Path, name: str) -> list[tuple[float, str]]:
    """Return time and file of each line of a list, in time."""
    found = []
    for number, line in read_list(place, name, key="data.root"):
        time, _, file = line.partition(" ")
        path = inside(place, file.strip(), where=f"'{place / name}' line {number}")
        try:
            found.append((float(time), path.relative_to(place).as_posix()))
        except ValueError:
            raise DataError(f"'{place / name}' line {number}: not a time and a file. Copy it again.") from None
    return sorted(found)


def associate(first: Sequence[float], second: Sequence[float], *, most_s: float) -> list[tuple[int, int]]:
    """Join times of two rising lists, nearest first, each at most once; returns positions in both, in time."""
    near = []
    for i, time in enumerate(first):
        j = bisect_left(second, time - most_s)
        while j < len(second) and second[j] - time <= most_s:
            near.append((abs(second[j] - time), i, j))
            j += 1
    taken_first, taken_second, pairs = set[int](), set[int](), []
    for _, i, j in sorted(near):
        if i not in taken_first and j not in taken_second:
            taken_first.add(i)
            taken_second.add(j)
            pairs.append((i, j))
    return sorted(pairs)
