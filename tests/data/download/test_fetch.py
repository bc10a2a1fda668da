"""Downloads from a server on this machine: whole, interrupted, resumed, wrong, and without a network."""

from __future__ import annotations

import hashlib
import shutil
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hudepth.base.errors import DataError
from hudepth.data.download import fetch as module
from hudepth.data.download.fetch import fetch
from hudepth.data.sources.base import Download
from hudepth.data.sources.nyu_mat import NyuMatSource
from tests.commands import Command

CONTENT = np.random.default_rng(0).bytes(300_000)
MD5 = hashlib.md5(CONTENT).hexdigest()


class Server(ThreadingHTTPServer):
    """Serves :data:`CONTENT`, and notes what it was asked for."""

    ranges = True
    cut: int | None = None
    """Bytes after which it hangs up."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked: list[str | None] = []

    @property
    def what(self) -> Download:
        return Download(f"http://127.0.0.1:{self.server_port}/set.mat", "set.mat", len(CONTENT), MD5)


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        wanted = self.headers["Range"]
        self.server.asked.append(wanted)
        if self.path != "/set.mat":
            self.send_error(404)
            return
        start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and self.server.ranges else 0
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(CONTENT) - start))
        self.end_headers()
        self.wfile.write(CONTENT[start:][: self.server.cut])

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture(autouse=True)
def _small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_PIECE", 10_000)


def refusal(what: Download, target: Path) -> str:
    with pytest.raises(DataError) as caught:
        fetch(what, target)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_whole_file(server: Server, tmp_path: Path) -> None:
    target = tmp_path / "new" / "set.mat"
    assert fetch(server.what, target).read_bytes() == CONTENT
    assert [path.name for path in target.parent.iterdir()] == ["set.mat"]
    fetch(server.what, target)
    assert server.asked == [None]  # once: it is there


@pytest.mark.parametrize("ranges", [True, False])
def test_an_interrupted_download_is_continued(ranges: bool, server: Server, tmp_path: Path) -> None:
    target, server.cut, server.ranges = tmp_path / "set.mat", 120_000, ranges
    message = refusal(server.what, target)
    assert "the connection ended after 0.1 of 0.3 MB" in message
    assert "run the same command again to continue after 0.1 MB" in message
    assert (tmp_path / "set.mat.part").stat().st_size == 120_000
    server.cut = None
    assert fetch(server.what, target).read_bytes() == CONTENT
    assert server.asked == [None, "bytes=120000-"]
    assert not (tmp_path / "set.mat.part").exists()


def test_another_file_is_not_kept(server: Server, tmp_path: Path) -> None:
    (tmp_path / "set.mat.part").write_bytes(b"x" * 100)  # of something else
    message = refusal(server.what, tmp_path / "set.mat")
    assert "has another MD5, so it is not the published file. It was deleted" in message
    assert list(tmp_path.iterdir()) == []
    for content, found in ((CONTENT[:-1], "299,999 bytes instead of 300,000"), (CONTENT[::-1], "another MD5")):
        (tmp_path / "set.mat").write_bytes(content)
        message = refusal(server.what, tmp_path / "set.mat")
        assert f"has {found}, so it is not the published file. Move it away" in message
        assert (tmp_path / "set.mat").read_bytes() == content  # it is the user's


def test_no_network(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    what = Download(f"http://127.0.0.1:{port}/set.mat", "set.mat", 10, MD5)
    message = refusal(what, tmp_path / "set.mat")
    assert message.startswith(f"cannot download {what.url} (")
    assert "Connection refused" in message
    fix = f"Go online and try again, or copy the file to '{tmp_path / 'set.mat'}' from another machine."
    assert message.endswith(f"). {fix}")


def test_a_missing_page(server: Server, tmp_path: Path) -> None:
    what = Download(server.what.url + "2", "set.mat", 10, MD5)
    assert "(404 Not Found)" in refusal(what, tmp_path / "set.mat")


def test_no_room(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=200_000))
    assert refusal(server.what, tmp_path / "set.mat").startswith("data.root: 0.00 GB are needed, 0.00 GB are free in '")
    (tmp_path / "set.mat.part").write_bytes(CONTENT[:150_000])
    fetch(server.what, tmp_path / "set.mat")
    (tmp_path / "file").touch()
    assert refusal(server.what, tmp_path / "file" / "set.mat").startswith("data.root: cannot write '")


def test_the_command(server: Server, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    what = server.what
    monkeypatch.setattr(NyuMatSource, "download", Download(what.url, "nyu_depth_v2_labeled.mat", what.size, what.md5))
    done = command("data", "download", "data=nyu_labeled_mat", "data.root=nyu")
    assert done.code == 0, done.err
    assert done.out.startswith("nyu/nyu_depth_v2_labeled.mat: complete. NYU Depth V2 (Silberman, ")
    assert (tmp_path / "nyu" / "nyu_depth_v2_labeled.mat").read_bytes() == CONTENT
    done = command("data", "download", "data=nyu_labeled_mat", "data.root=nyu/nyu_depth_v2_labeled.mat")
    assert "is there and complete" in done.err
    for arguments, message in (
        (["data=nyu_labeled_mat"], "data.root is not set. Pass data.root=<folder for nyu_depth_v2_labeled.mat, "),
        (
            ["data=kitti", "data.root=x"],
            "data: there is no download of kitti. See https://www.cvlibs.net/datasets/kitti/;",
        ),
        (["data=rooms"], "data: there is no download of rooms. It needs none"),
    ):
        done = command("data", "download", *arguments)
        assert done.code == 1
        assert message in done.err.splitlines()[-1]


def test_what_nyu_published() -> None:
    what = NyuMatSource.download
    assert what is not None
    assert (what.size, what.md5) == (2_972_037_809, "520609c519fba3ba5ac58c8fefcc3530")
