"""A checkpoint of an untrained network, and files that visitors may upload."""

from __future__ import annotations

import io
import struct
import zlib
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
