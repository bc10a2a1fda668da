"""What every source of image/depth pairs offers. A source lists its records cheaply and reads one pair at a time."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError


@dataclass(frozen=True, slots=True)
class Record:
    """One image/depth pair of a source, named but not read."""

    id: str
    """Unique in its source and the same on every machine, for example ``00012`` or ``kitchen_0004/17``."""
    scene: str
    """Frames of one scene belong together: a scene-disjoint split never separates them."""
    frame: int
    """Position within the scene (video order where there is one)."""
    split: str = ""
    """The set's own split: ``train``, ``test``, or empty where it has none."""
    category: str = ""
    """Kind of scene where the set knows it, for example ``kitchen``."""
    image: str = ""
    """Where the image lies, as the source's ``read`` understands it (a path relative to the root, or empty)."""
    depth: str = ""
    """Where the depth lies, likewise."""
    depth_scale_m: float | None = None
    """For the ``linear`` encoding: depth [m] = (value + depth_offset) * depth_scale_m."""
    depth_offset: float = 0.0
    """For the ``linear`` encoding, in units of the stored value."""


@dataclass(frozen=True, slots=True)
class RawPair:
    """One pair as its files hold it: decoded, but with depth still in the source's own encoding."""

    image: NDArray[np.uint8]
    """[H, W, 3] RGB."""
    depth: NDArray[np.generic]
    """[H, W], any dtype, in the units of the source's encoding."""


class Source(ABC):
    """A data set in some form on disk (or made up), seen as a list of records and a way to read each.

    A source is picklable, so that worker processes can have a copy: file handles are opened lazily and left behind.
    """

    name: ClassVar[str]
    """What the configuration calls it."""
    encoding: str
    """How depth values become metres; one of :data:`hudepth.data.encoding.ENCODINGS`."""
    indoor: bool = True
    """Indoor sets are refused if their median depth is implausible for a room."""
    auto_uint8: ClassVar[str | None] = None
    """What 8-bit depth means under ``encoding=auto``; None where only the user can know."""

    @abstractmethod
    def records(self) -> Sequence[Record]:
        """List all pairs in a stable order, without opening an image.

        Raises:
            DataError: if the root or its index is missing, malformed or empty.
        """

    @abstractmethod
    def read(self, record: Record) -> RawPair:
        """Decode one pair.

        Raises:
            DataError: if a file is missing, truncated, or the two differ in size; the message names the file.
        """

    def files(self) -> Sequence[Path]:
        """Every file this source reads (none for a source that makes its frames up)."""
        return []

    def fingerprint(self) -> str:
        """sha256 over the records and the sizes of their files: equal on every machine that holds the same set.

        Raises:
            DataError: as :meth:`records`.
        """
        digest = hashlib.sha256(json.dumps([asdict(record) for record in self.records()]).encode())
        for path in self.files():
            size = path.stat().st_size if path.exists() else -1
            digest.update(f"{path.name}:{size};".encode())
        return digest.hexdigest()


def existing_root(root: str | Path | None, *, expects: str) -> Path:
    """Return ``root`` as a path.

    Args:
        root: what the user gave as ``data.root``.
        expects: what should be there, for the error message.

    Raises:
        DataError: if no root was given or it does not exist.
    """
    if not root:
        raise DataError(f"data.root is not set. Pass data.root=<{expects}>, or run with data=rooms.")
    path = Path(root).expanduser()
    if not path.exists():
        raise DataError(f"data.root: '{path}' does not exist. Pass data.root=<{expects}>, or run with data=rooms.")
    return path
