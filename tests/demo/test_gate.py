"""Who may ask the page, how much they may send, and what the server's log says of it."""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from hudepth.base.errors import ConfigError
from hudepth.demo.gate import POLICY, Gate, host_names
from hudepth.demo.session_files import Files

from .conftest import encoded, served, until


async def well(scope: Any, receive: Any, send: Any) -> None:
    while (await receive()).get("more_body"):
        pass
    await send({"type": "http.response.start", "status": 200, "headers": [(b"a", b"b")]})


def asked(
    files: Files,
    app: Any = well,
    *,
    hosts: Sequence[bytes] = (b"localhost",),
    path: str = "/",
    body: int = 0,
    **scope: Any,
) -> list[Any]:
    """What the gate sends in answer to a request that arrives in pieces of 1000 bytes."""
    sent: list[Any] = []
    pieces = [{"type": "http.request", "body": bytes(1000), "more_body": True}] * (body // 1000)
    left = iter([*pieces, {"type": "http.request", "body": b"", "more_body": False}])

    async def receive() -> Any:
        return next(left)

    async def send(message: Any) -> None:
        sent.append(message)

    gate = Gate(app, files, hosts=host_names(["Depth.example.org", "fd00::1"]), upload_bytes=50_000)
    headers = [(b"host", host) for host in hosts]
    request = {"type": "http", "method": "POST", "path": path, "headers": headers, "server": ("192.0.2.7", 80)}
    asyncio.run(gate({**request, **scope}, receive, send))
    return sent


@pytest.fixture
def files() -> Iterator[Files]:
    with Files(keep_bytes=100_000) as opened:
        yield opened


def test_every_answer_carries_the_policy(files: Files) -> None:
    headers = asked(files)[0]["headers"]
    assert headers[:2] == [(b"a", b"b"), (b"content-security-policy", POLICY.encode())]
    assert "http" not in POLICY


OWN = ["localhost", "LOCALHOST:7860", "127.0.0.1:1", "[::1]:80", "192.0.2.7", "depth.example.org:443", "[fd00::1]"]


@pytest.mark.parametrize("host", OWN)
def test_own_names_are_answered(files: Files, host: str) -> None:
    assert asked(files, hosts=[host.encode()])[0]["status"] == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example", "a@localhost", "localhost:1:2", "192.0.2.8", "", "loc\xe4l"]
)
def test_foreign_names_are_refused(files: Files, host: str) -> None:
    start, body = asked(files, hosts=[host.encode("latin-1")])
    assert start["status"] == 403
    assert b"allowed_hosts" in body["body"]
    assert body["body"].count(b"\n") == 1
    (closed,) = asked(files, hosts=[host.encode("latin-1")], type="websocket")
    assert closed["type"] == "websocket.close"


def test_a_request_names_one_host(files: Files) -> None:
    assert asked(files, hosts=[])[0]["status"] == 403
    assert asked(files, hosts=[b"localhost", b"evil.example"])[0]["status"] == 403


@pytest.mark.parametrize("name", ["http://a.b", "*", "a b", "", "a/b"])
def test_allowed_hosts_are_names(name: str) -> None:
    with pytest.raises(ConfigError, match="allowed_hosts"):
        host_names([name])


def test_requests_are_bounded(files: Files) -> None:
    assert asked(files, path="/gradio_api/upload", body=50_000)[0]["status"] == 200
    assert asked(files, path="/gradio_api/upload", body=200_000)[0]["status"] == 413
    assert asked(files, path="/gradio_api/queue/join", body=2_000_000)[0]["status"] == 413


def test_a_failure_is_a_line(files: Files, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    async def fails(*_: Any) -> None:
        raise KeyError("two\nlines")

    monkeypatch.setattr("hudepth.base.console.log.propagate", True)
    asked(files, fails, path="/a\nb")
    (record,) = caplog.records
    assert "KeyError" in record.message
    assert "\n" not in record.message


def form(data: bytes, name: str = "a.png") -> tuple[bytes, dict[str, str]]:
    head = f'--x\r\nContent-Disposition: form-data; name="files"; filename="{name}"\r\n\r\n'
    return head.encode() + data + b"\r\n--x--\r\n", {"Content-Type": "multipart/form-data; boundary=x"}


def request(url: str, method: str, path: str, body: bytes = b"", headers: dict[str, str] | None = None) -> int:
    connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=20)
    connection.request(method, path, body or None, headers or {})
    answer = connection.getresponse()
    if "event-stream" not in (answer.headers["Content-Type"] or ""):
        answer.read()
    connection.close()
    return answer.status


def held_bytes(folder: Path) -> int:
    """Return the size of all files, some of which may be deleted meanwhile."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                total += (Path(parent) / name).stat().st_size
    return total


@pytest.mark.slow
def test_a_started_server(checkpoint: Path, tmp_path: Path) -> None:
    pytest.importorskip("gradio", reason="gradio is not installed")
    api, options = "/gradio_api", ("max_upload_mb=1", "max_kept_mb=5", "allowed_hosts=[depth.example.org]")
    with served(checkpoint, tmp_path, *options) as (process, url):
        for path in ("/", "/config", f"{api}/queue/data?session_hash=a", f"{api}/heartbeat/a", f"{api}/info"):
            assert request(url, "GET", path, headers={"Host": "evil.example"}) == 403
        assert request(url, "OPTIONS", "/", headers={"Host": "evil.example", "Origin": "http://evil.example"}) == 403
        for host in ("localhost:1", "[::1]", "depth.example.org"):
            assert request(url, "GET", "/", headers={"Host": host}) == 200
        for _ in range(20):  # of clients that never open a session
            assert request(url, "POST", f"{api}/upload", *form(os.urandom(900_000))) == 200
        uploads = next((tmp_path / "temporary").glob("hudepth-demo-*")) / "uploads"
        assert until(lambda: 0 < held_bytes(uploads) < 5 * 2**20)
        assert request(url, "POST", f"{api}/upload", *form(bytes(1_500_000))) == 413
        lines = bad_requests(url, api)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=30)
    assert "Traceback" not in out
    assert len(out.splitlines()) <= lines + 7


def bad_requests(url: str, api: str) -> int:
    """Ask what gradio fails at; return how many requests that were."""
    json_type = {"Content-Type": "application/json"}
    bodies: list[bytes] = [b"{", b"[]", b"\xff", b"null"]
    for data in (None, [1], [{"path": "/etc/passwd", "meta": {"_type": "gradio.FileData"}}], [{"path": 5}], []):
        each = {"data": data, "session_hash": "a"}
        bodies += [json.dumps({**each, "fn_index": index}).encode() for index in (1, 99, "x")]
    for body in bodies:
        for path in (f"{api}/queue/join", f"{api}/run/predict", f"{api}/component_server"):
            request(url, "POST", path, body, json_type)
    request(url, "POST", f"{api}/upload", b"garbage", form(b"")[1])
    return 3 * len(bodies) + 1


@pytest.mark.slow
def test_eighty_abandoned_pictures(checkpoint: Path, tmp_path: Path) -> None:
    pytest.importorskip("gradio", reason="gradio is not installed")
    picture = encoded(400, 400, "BMP")
    with served(checkpoint, tmp_path) as (process, url):
        for number in range(80):
            data = picture + number.to_bytes(4, "big") + bytes(4 << 20)
            assert request(url, "POST", "/gradio_api/upload", *form(data, "a.bmp")) == 200
        assert held_bytes(tmp_path) < 250 * 2**20
        assert process.poll() is None
