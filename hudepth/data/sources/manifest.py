"""Pairs listed in a CSV file, and the labelled NYU set kept that way."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import ClassVar
from unicodedata import normalize

from hudepth.base.camera import CameraOption
from hudepth.base.errors import DataError
from hudepth.base.images import read_bytes
from hudepth.data.encoding import Encoding
from hudepth.data.sources.base import Record, existing_root
from hudepth.data.sources.files import FileSource, csv_rows, inside
from hudepth.data.sources.nyu import Nyu

_REQUIRED = ("image", "depth")


@dataclass(eq=False)
class ManifestSource(FileSource):
    """Any set of pairs with a list: a CSV file next to the data, a header and then one line per pair.

    ================= ========================================================================================
    column            content
    ================= ========================================================================================
    image             JPEG or PNG, a path relative to the folder of the data
    depth             PNG of 8 or 16 bits, ``.npy`` or TIFF, likewise
    id or index       optional, unique; the image's path without extension if there is neither
    scene             optional; frames of a scene belong together
    frame             optional whole number; position within the scene, by default in order of the list
    split             optional: ``train``, ``val``, ``test`` or empty; without ``val``, it is taken from ``train``
    category          optional: kind of scene
    depth_scale_m     optional [m]: depth = (value + depth_offset) * depth_scale_m, see ``linear`` in
                      :func:`hudepth.data.encoding.to_metres`
    depth_offset      optional, in units of the stored value; 0 where empty
    ================= ========================================================================================

    Paths must stay inside the folder. ``root`` is the folder, or the CSV file itself; ``manifest`` is the name of the
    CSV file within the folder.
    """

    name: ClassVar[str] = "manifest"
    upright: ClassVar[bool] = True

    root: str | Path | None
    _: KW_ONLY
    manifest: str = "index.csv"
    encoding: Encoding = "auto"
    indoor: bool = True
    farthest_m: float | None = None
    sparse: bool = False
    camera: CameraOption | None = None
    unequal_sizes: bool = False

    def records(self) -> Sequence[Record]:
        """List the pairs in order of the CSV file; see :meth:`Source.records`."""
        folder, index = self._place()
        rows = csv_rows(read_bytes(index), where=f"'{index}'")
        header = [cell.strip() for cell in rows[0][1]] if rows else []
        if missing := [column for column in _REQUIRED if column not in header]:
            raise DataError(
                f"'{index}': no column {' and '.join(missing)}, found {', '.join(header) or 'nothing'}. "
                "Name the columns in its first line."
            )
        records: list[Record] = []
        lines: dict[str, int] = {}
        frames: dict[str, int] = {}
        for line, cells in rows[1:]:
            where = f"'{index}' line {line}"
            while len(cells) > len(header) and not cells[-1].strip():  # commas that Excel adds
                cells.pop()
            if len(cells) != len(header):
                raise DataError(f"{where}: {len(cells)} cells for {len(header)} columns. Complete the line.")
            row = {column: cell.strip() for column, cell in zip(header, cells, strict=True)}
            row |= {column: row[column].replace("\\", "/") for column in _REQUIRED}  # written on Windows
            record = self._record(row, folder, frames, where)
            if record.id in lines:
                raise DataError(f"{where}: id '{record.id}' is taken by line {lines[record.id]}. Make ids unique.")
            lines[record.id] = line
            records.append(record)
        if not records:
            raise DataError(f"'{index}': lists no pairs. Add a line for each pair.")
        return records

    def folder(self) -> Path:
        """Return the folder of the CSV file."""
        return self._place()[0]

    def files(self) -> Sequence[Path]:
        """Return the CSV file and every file it lists."""
        return [self._place()[1], *super().files()]

    def _place(self) -> tuple[Path, Path]:
        root = existing_root(self.root, expects=f"folder with {self.manifest}")
        if root.is_file():
            return root.parent, root
        index = inside(root, self.manifest, where="data.source.manifest")
        if not index.is_file():
            raise DataError(
                f"data.root: no file '{self.manifest}' in '{root}'. "
                f"Pass data.root=<folder with {self.manifest}>, or run with data=rooms."
            )
        return root, index

    def _record(self, row: Mapping[str, str], folder: Path, frames: dict[str, int], where: str) -> Record:
        for column in _REQUIRED:
            if not row[column]:
                raise DataError(f"{where}: the cell of {column} is empty. Complete the line, or remove it.")
            inside(folder, row[column], where=where)
        scene, split = row.get("scene", ""), row.get("split", "")
        if split not in ("", "train", "val", "test"):
            raise DataError(f"{where}: unknown split '{split}'. Write train, val, test, or nothing.")
        frames[scene] = frames.get(scene, -1) + 1
        frame = row.get("frame") or str(frames[scene])
        if not (frame.isascii() and frame.isdigit() and len(frame) < 19):
            raise DataError(f"{where}: frame is '{frame}'. Write a whole number, or leave the cell empty.")
        scale_m = _number(row, "depth_scale_m", where)
        if scale_m is not None and scale_m <= 0:
            raise DataError(f"{where}: depth_scale_m is {scale_m:g}. Write a positive number of metres.")
        return Record(
            id=self._row_id(row),
            scene=scene,
            frame=int(frame),
            split=split,
            category=row.get("category", ""),
            image=_on_disk(folder, row["image"]),
            depth=_on_disk(folder, row["depth"]),
            depth_scale_m=scale_m,
            depth_offset=_number(row, "depth_offset", where) or 0.0,
        )

    def _row_id(self, row: Mapping[str, str]) -> str:
        return row.get("id") or row.get("index") or str(Path(row["image"]).with_suffix("").as_posix())


@dataclass(eq=False)
class NyuLabeledSource(Nyu, ManifestSource):
    """The labelled NYU Depth V2 set as single files, its depth in 8 bits with one scale per image.

    1449 pairs of 640 x 480 from 464 scenes, official split of 795 training and 654 test frames (Silberman,
    Hoiem, Kohli and Fergus, ECCV 2012). ``NNNNN.jpg`` is the image and ``NNNNN.png`` the in-painted depth;
    ``index.csv`` gives the scale and offset that turn it into metres, in steps of 5 to 39 mm. Columns as in
    :class:`ManifestSource`; the id is ``index``, which counts from 0, padded to five digits.
    """

    name: ClassVar[str] = "nyu_labeled"

    def _row_id(self, row: Mapping[str, str]) -> str:
        return super()._row_id(row).zfill(5)


def _on_disk(folder: Path, name: str) -> str:
    """Return a name with its accents as the file has them: Macs write them as letters of their own."""
    forms = () if name.isascii() else (name, normalize("NFC", name), normalize("NFD", name))
    return next((form for form in forms if (folder / form).exists()), name)


def _number(row: Mapping[str, str], column: str, where: str) -> float | None:
    if not (text := row.get(column)):
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"{where}: {column} is '{text}'. Write a finite number, or leave the cell empty.")
    return value
