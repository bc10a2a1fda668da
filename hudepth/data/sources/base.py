"""The interface of a data set: it lists its records cheaply and reads one pair at a time."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from hudepth.base.camera import CameraChoice, CameraOption
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.options import Range, check, convert
from hudepth.data.encoding import Encoding


@dataclass(frozen=True, slots=True)
class Record:
    """One image/depth pair of a source, before it is read."""

    id: str
    """Unique in its source and the same on every machine, for example ``00012`` or ``kitchen_0004/17``."""
    scene: str
    frame: int
    """Position within the scene (video order where there is one)."""
    split: str = ""
    """The data set's own split: ``train``, ``test``, or empty if it has none."""
    category: str = ""
    """Kind of scene, for example ``kitchen``; empty if unknown."""
    image: str = ""
    depth: str = ""
    """As ``image``: where the source's ``read`` finds it, usually a path relative to the root."""
    depth_scale_m: float | None = None
    depth_offset: float = 0.0
    """For the ``linear`` encoding: depth [m] = (value + depth_offset) * depth_scale_m."""


@dataclass(frozen=True, slots=True)
class Download:
    """A file that anybody may download, as its authors published it."""

    url: str
    file: str
    """Its name in ``data.root``."""
    size: int
    """Bytes."""
    md5: str


@dataclass(frozen=True, slots=True)
class RawPair:
    """One pair, decoded: image [H, W, 3] RGB, and depth [H, W] of any dtype, still in the source's own encoding."""

    image: NDArray[np.uint8]
    depth: NDArray[np.generic]


_SCALE = Annotated[float, Range(0, above=True)]
FARTHEST = Annotated[float, Range(0, 65_535, above=True)]
"""A depth [m] that 16 bits can hold in whole metres."""


class Source(ABC):
    """A data set in some form on disk, or generated: a list of records and a way to read each. Stores bear its name.

    To add a data set, write one subclass and one configuration file in ``conf/data/``. Sources must be picklable, since
    worker processes get a copy: open file handles lazily (:class:`hudepth.data.sources.files.PerProcess`).
    """

    name: ClassVar[str]
    homepage: ClassVar[str] = ""
    licence: ClassVar[str] = "other"
    """Licence identifier of the data for model cards, for example ``mit``."""
    download: ClassVar[Download | None] = None
    """What ``hudepth-data download`` fetches; None: sets that ask for an account, or have several parts."""
    terms: ClassVar[str] = ""
    """What the data is and what its owners permit, in a sentence for model cards."""
    encoding: str
    """How depth values become metres; one of :data:`hudepth.data.encoding.ENCODINGS`."""
    indoor: bool = True
    """Whether depths must be plausible for rooms."""
    usual_median_m: tuple[float, float] | None = None
    """Median depths [m] the set can have, which a wrong unit leaves; None: those of rooms, if it is indoors."""
    farthest_m: float | None = None
    """Largest depth [m] the store must hold; None: 65.535 m indoors, else 255.996 m. Steps are as fine as it allows."""
    sparse: bool = False
    """Whether few pixels are measured, as by a lidar: measured ones are preferred at training size."""
    camera: CameraOption | None = None
    """Which took the images, as ``camera=`` of hudepth-predict states it; None: not known, or NYU's by the source."""
    depth_scale_m: float | None = None
    """Scale of ``linear`` and ``disparity`` where a record has none; see :func:`hudepth.data.encoding.to_metres`."""
    invalid: Sequence[float] | None = None
    """Stored values that mean "no reading"; None: the largest of an integer type of 16 bits or more."""
    pairs_per_scene: int | None = None
    """How many pairs :meth:`generated` takes of one scene; None if the data is in files."""
    unpaired: list[str] | None = None
    """A list if :meth:`records` is to leave out files without partner and note them there; None if to refuse them."""
    auto_uint8: ClassVar[str | None] = None
    """Encoding of 8-bit depth under ``encoding=auto``; None if only the user can know."""

    def __post_init__(self) -> None:  # of sources that are dataclasses: their fields are their options
        self.encoding = convert("data.encoding", self.encoding, Encoding | None)
        self.depth_scale_m = convert("data.depth_scale_m", self.depth_scale_m, _SCALE | None)
        self.invalid = convert("data.invalid", self.invalid, list[float] | None)
        self.camera = convert("data.source.camera", self.camera, CameraOption | None)
        if self.camera is not None:
            CameraChoice.of(self.camera, key="data.source.camera")
        self.farthest_m = convert("data.source.farthest_m", self.farthest_m, FARTHEST | None)
        if self.depth_scale_m is not None and self.encoding not in (None, "auto", "linear", "disparity"):
            raise ConfigError(
                f"data.depth_scale_m: data.encoding={self.encoding} has a scale of its own. "
                "Pass data.encoding=linear or disparity, or leave it out."
            )
        check(self, prefix="data.source.")

    @abstractmethod
    def records(self) -> Sequence[Record]:
        """List all pairs in a stable order, without opening an image.

        Raises DataError if the root or its index is missing, malformed or empty.
        """

    @abstractmethod
    def read(self, record: Record) -> RawPair:
        """Decode one pair; DataError if a file is missing, truncated, too large, or image and depth do not fit."""

    def generated(self, number: int) -> Record:
        """Return the record of a new pair, which is none of :meth:`records`, for sources that generate their data."""
        raise NotImplementedError(f"{self.name}: the data is in files")

    def files(self) -> Sequence[Path]:
        """Return every file this source reads; empty for generated data."""
        return []

    def fingerprint(self) -> str:
        """Return a sha256 over the records and the sizes of their files, equal on every machine with the same data."""
        digest = hashlib.sha256(json.dumps([asdict(record) for record in self.records()]).encode())
        for path in self.files():
            size = path.stat().st_size if path.exists() else -1
            digest.update(f"{path.name}:{size};".encode("utf-8", "surrogateescape"))
        return digest.hexdigest()


@dataclass(eq=False, kw_only=True)
class EncodedSource(Source):
    """A source of files, whose values can mean anything: their scale and invalid values are options."""

    depth_scale_m: float | None = None
    invalid: Sequence[float] | None = None


def existing_root(root: str | Path | None, *, expects: str) -> Path:
    """Return ``data.root`` as a path; DataError, with what it ``expects``, if none was given or it does not exist."""
    if root and (path := Path(root).expanduser()).exists():
        return path
    found = f": '{root}' does not exist" if root else " is not set"
    raise DataError(f"data.root{found}. Pass data.root=<{expects}>, or run with data=rooms.")
