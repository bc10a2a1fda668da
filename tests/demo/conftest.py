"""A checkpoint of a network that learnt nothing, and the files a stranger may send."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hudepth.inference.model import DepthModel, load
from hudepth.models import TinyUNet
from hudepth.runs.checkpoint import KEY, VERSION


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    net = TinyUNet(channels=4)
    torch.nn.init.normal_(net.decode.weight, std=2.0)  # so that depth differs from pixel to pixel
    own = {
        "version": VERSION,
        "config": {
            "model": {"_target_": "hudepth.models.TinyUNet", "channels": 4},
            "data": {"size": [32, 48], "max_depth_m": 10.0},
        },
        "split": {},
        "data": {"source": "rooms<b>"},
    }
    path = tmp_path_factory.mktemp("demo") / "tiny.ckpt"
    state = {f"net.{name}": tensor for name, tensor in net.state_dict().items()}
    torch.save({"epoch": 4, "state_dict": state, KEY: own}, path)
    return path


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
    "empty.png": (b"", "'empty.png': the file is empty (0 bytes). Copy it again."),
    "text.png": (
        b"no picture at all",
        "'text.png': no image that can be read. Pass a JPEG, PNG, ",
    ),
    "large.png": (
        bomb(20_000),
        "'large.png': more pixels than are decoded here. Resize the file.",
    ),
    "larger.png": (
        bomb(7_000),
        "'larger.png': 7000 x 7000 pixels, at most 40 million are taken. Resize the picture.",
    ),
    "cut.jpg": (
        encoded(60, 80, "JPEG")[:900],
        "'cut.jpg': cannot be decoded, the file is truncated or damaged",
    ),
    "figure.jpg": (
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\nshowpage\n",
        "'figure.jpg': no image that can be read. Pass a JPEG, PNG, ",
    ),
}
"""By name: what is sent, and how the answer to it begins."""
