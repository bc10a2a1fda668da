"""What the page keeps on disk while it runs: a temporary folder with the last picture of each session."""

from __future__ import annotations

import contextlib
import secrets
import shutil
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hudepth.base.errors import DataError
from hudepth.base.images import resize_image
from hudepth.base.machine import usable_cores
from hudepth.data.sources.rooms import RoomsSource
from hudepth.demo.answers import Answer
from hudepth.inference.depth_files import FORMATS, Style
from hudepth.inference.depth_map import jpeg

EXAMPLE_ROOMS = (3, 21, 14, 0)  # scenes of the synthetic rooms: a living room, a kitchen, an office, a bedroom
EXAMPLE_SIZE = (480, 640)
DOWNLOADS = ("colour", "png16", "npy", "ply", "glb")  # formats that can be downloaded, in the order of the buttons
_BLOCK = 4096  # bytes of a disk that the smallest file takes


@dataclass
class _Session:
    upload: Path | None = None
    results: Path | None = None


class Files:
    """The folder of a running page, deleted when it ends; used as ``with Files() as files``.

    All sessions together keep at most ``keep_bytes``, or the newest picture's files alone.
    """

    def __init__(self, keep_bytes: int = 200 << 20) -> None:
        self.keep_bytes = keep_bytes
        self._sessions: dict[str, _Session] = {}
        self._lock = threading.Lock()

    def __enter__(self) -> Files:
        self.root = Path(tempfile.mkdtemp(prefix="hudepth-demo-")).resolve()
        self.uploads, self.results, self.examples = (self.root / n for n in ("uploads", "results", "examples"))
        for folder in (self.uploads, self.results, self.examples):
            folder.mkdir()
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.root, ignore_errors=True)

    def begin(self, session: str, upload: Path) -> None:
        """Record what a session uploaded, and delete its previous files."""
        uploaded = upload if upload.is_relative_to(self.uploads) else None  # examples are kept
        self.end(session, _Session(uploaded))

    def end(self, session: str, successor: _Session | None = None) -> None:
        """Delete everything that belongs to this session only."""
        with self._lock:
            before = self._sessions.pop(session, _Session())
            if successor is not None:
                self._sessions[session] = successor
            # gradio stores a picture uploaded twice as one file
            kept = {each.upload for each in self._sessions.values()}
            if before.upload is not None and before.upload not in kept:
                before.upload.unlink(missing_ok=True)
        if before.results is not None:
            shutil.rmtree(before.results, ignore_errors=True)

    def trim(self) -> None:
        """Delete the oldest uploads and results until no more than ``keep_bytes`` are left, whoever owns them."""
        with self._lock:
            held = 0
            entries = [_size(entry) for folder in (self.uploads, self.results) for entry in folder.iterdir()]
            for number, (_, size, entry) in enumerate(sorted(entries, reverse=True)):
                held += size
                if number and held > self.keep_bytes:
                    shutil.rmtree(entry, ignore_errors=True)
                    with contextlib.suppress(OSError):
                        entry.unlink(missing_ok=True)

    def write(self, session: str, answer: Answer) -> list[Path | None]:
        """Write a session's downloads, in the order of :data:`DOWNLOADS`, into a folder with an unguessable name.

        Colours, PNG and npy have the size of the picture; point clouds have the points that are shown, without those at
        edges of depth. None stands for a format that cannot hold the picture. Raises OSError.
        """
        folder = self.results / secrets.token_urlsafe(16)
        folder.mkdir()
        with self._lock:
            self._sessions.setdefault(session, _Session()).results = folder
        paths: list[Path | None] = []
        for name in DOWNLOADS:
            ending, write = FORMATS[name]
            path = folder / f"{answer.name}{ending}"
            try:
                with path.open("wb") as file:
                    write(answer.shown if name in ("ply", "glb") else answer.depth, file, Style())
                paths.append(path)
            except DataError:
                path.unlink()
                paths.append(None)
        return paths


def _size(entry: Path) -> tuple[float, int, Path]:
    """Return when a file or folder was changed, and its bytes on disk; 0 for what has gone meanwhile."""
    try:
        sizes = [max(path.lstat().st_size, _BLOCK) for path in (entry, *entry.rglob("*"))]
        return entry.lstat().st_mtime, sum(sizes), entry
    except OSError:
        return 0.0, 0, entry


def draw_examples(folder: Path) -> list[Path]:
    """Render pictures of synthetic rooms into a folder, in twice their size, for smooth edges."""
    height, width = EXAMPLE_SIZE
    rooms = RoomsSource(scenes=max(EXAMPLE_ROOMS) + 2, frames_per_scene=1, size=(2 * height, 2 * width))
    records = rooms.records()

    def draw(scene: int) -> Path:
        path = folder / f"{records[scene].category}.jpg"
        image = np.asarray(rooms.read(records[scene]).image, np.uint8)
        path.write_bytes(jpeg(resize_image(image, EXAMPLE_SIZE), quality=95))
        return path

    with ThreadPoolExecutor(usable_cores()) as pool:
        return list(pool.map(draw, EXAMPLE_ROOMS))
