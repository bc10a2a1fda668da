"""A checkpoint of an untrained network, and files that visitors may upload."""

from __future__ import annotations

import contextlib
import io
import os
import re
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hudepth.inference.model import DepthModel, load
from tests.networks import write_tiny_checkpoint


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_checkpoint(tmp_path_factory.mktemp("demo") / "tiny.ckpt", source="rooms<b>")


@pytest.fixture(scope="session")
def model(checkpoint: Path) -> DepthModel:
    return load(checkpoint, device="cpu", threads=1)


@contextlib.contextmanager
def served(
    checkpoint: Path, folder: Path, *options: str, **environment: str
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The installed script on a free port, with temporary files in a folder: the process and its address."""
    (folder / "temporary").mkdir()
    script = [str(Path(sys.executable).parent / "hudepth-demo"), f"checkpoint={checkpoint}", "port=0", "threads=1"]
    process = subprocess.Popen(
        [*script, *options], cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        env={**os.environ, "OMP_NUM_THREADS": "1", "TMPDIR": str(folder / "temporary"), **environment},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.fullmatch(r"model: TinyUNet of .*; open (http://127\.0\.0\.1:\d+) \(Ctrl-C stops\)\n", line)
        assert found, line + process.stdout.read()
        yield process, found[1]
    finally:
        process.kill()
        process.wait()


def until(condition: Callable[[], bool], seconds: float = 60) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


def encoded(height: int, width: int, kind: str = "PNG") -> bytes:
    """A picture of random colours."""
    rgb = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(rgb).save(file, kind)
    return file.getvalue()


def bomb(side: int) -> bytes:
    """A PNG of a few kilobytes that says it has side x side pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    data = zlib.compress(bytes(2_000_000), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


HOSTILE = {
    "empty.png": (b"", "'empty.png': the file is empty"),
    "text.png": (
        b"no picture at all",
        "'text.png': ",
    ),
    "large.png": (
        bomb(20_000),
        "'large.png': ",
    ),
    "larger.png": (
        bomb(7_000),
        "'larger.png': 7000 x 7000 pixels",
    ),
    "cut.jpg": (
        encoded(60, 80, "JPEG")[:900],
        "'cut.jpg': ",
    ),
    "figure.jpg": (
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\nshowpage\n",
        "'figure.jpg': ",
    ),
}
"""By name: what is sent, and how the answer to it begins."""
