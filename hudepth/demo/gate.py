"""What stands before gradio's app: who may ask, how much they may send, and one line in the log for what fails."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from types import SimpleNamespace
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.demo.session_files import Files

POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; object-src 'none'; form-action 'self'; frame-ancestors 'none'"
)
"""Browsers load nothing from other hosts. gradio itself needs inline scripts and eval."""
LOCAL = ("localhost", "127.0.0.1", "::1")
"""Hosts by which this machine calls itself."""
_HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([\w.-]+))(?::\d+)?", re.ASCII)
_MAX_JSON = 1 << 20  # bytes of a request that is no upload
_FORM = 1 << 16  # bytes that a form adds to a file


class _RefusalError(Exception):
    """A request that is answered by a status and a reason."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def host_names(allowed: Sequence[str]) -> frozenset[str]:
    """Return names of hosts as requests are compared with; raises ConfigError for what is no name or address."""
    for name in allowed:
        if not (_HOST.fullmatch(name.lower()) or re.fullmatch(r"[0-9a-f:.]+", name.lower())):
            fix = "Pass names or addresses, allowed_hosts=[depth.example.org]."
            raise ConfigError(f"allowed_hosts: {name!r} is no name of a host. {fix}")
    return frozenset(_host(name) or name.lower() for name in allowed)


def _host(header: str) -> str | None:
    found = _HOST.fullmatch(header.lower())
    return found and (found[1] or found[2])


class Gate:
    """ASGI application around gradio's.

    A request must name a host that is this machine, the address it arrived at or one of ``hosts``: else any web page
    could reach the server through a name of its own that it points here (DNS rebinding). Uploads on their way count,
    as all that ``files`` keeps. Responses carry :data:`POLICY`.
    """

    def __init__(self, app: Any, files: Files, hosts: frozenset[str], upload_bytes: int) -> None:
        self._app, self._files, self._upload_bytes = app, files, upload_bytes
        self._hosts = hosts | set(LOCAL)
        self._arriving = 0  # bytes of requests that are being received

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Handle a request."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        upload = scope["path"].rstrip("/").endswith("/upload")
        most, received, status = (self._upload_bytes + _FORM if upload else _MAX_JSON), 0, 0
        refusal = self._foreign(scope)

        async def counted() -> Any:
            nonlocal received, refusal
            message = await receive()
            size = len(message.get("body", b""))
            received, self._arriving = received + size, self._arriving + size
            if received > most:
                refusal = _RefusalError(413, f"more than {most} bytes")
            elif self._arriving > max(self._files.keep_bytes, most):
                refusal = _RefusalError(503, "too many uploads at once")
            if refusal:
                raise refusal
            return message

        async def watched(message: Any) -> None:
            nonlocal status
            if refusal:
                return  # gradio calls it an error of the server
            if message["type"] == "http.response.start":
                status = message["status"]
                extra = [(b"content-security-policy", POLICY.encode()), (b"referrer-policy", b"no-referrer")]
                message = {**message, "headers": [*message.get("headers", []), *extra]}
            await send(message)

        failure = ""
        try:
            if refusal is None:
                await self._app(scope, counted, watched)
        except Exception as error:  # gradio answers what it does not expect with any exception
            if 0 < status < 400:
                raise  # too late for an answer; the server writes its line
            failure = _line(error)
        finally:
            self._arriving -= received
            if upload:
                await asyncio.to_thread(self._files.trim)
        if refusal and not status:
            status, failure = refusal.status, str(refusal)
            await _answer(scope, send, status, failure)
        if failure or (status >= 400 and status != 404):  # gradio's own page asks for what is not there
            words = ascii(f"{scope.get('method', 'websocket')} {scope['path']}"[:200])[1:-1]
            log.warning("%s: %s", words, " ".join(filter(None, [str(status or ""), failure])))

    def _foreign(self, scope: Any) -> _RefusalError | None:
        named = [value.decode("latin-1") for key, value in scope["headers"] if key == b"host"]
        if len(named) == 1 and _host(named[0]) in self._hosts | {(scope.get("server") or [""])[0]}:
            return None
        found = ascii(", ".join(named)[:100])
        return _RefusalError(403, f"the host {found} is not this one; allowed_hosts= admits further names")


def guarded(files: Files, hosts: frozenset[str], upload_bytes: int) -> Callable[[Any], Any]:
    """Return a lifespan of an app that puts a gate before everything else, also before gradio's own middleware."""

    @contextlib.asynccontextmanager
    async def lifespan(app: Any) -> AsyncIterator[None]:
        app.middleware_stack = Gate(app.middleware_stack, files, hosts, upload_bytes)
        yield

    return lifespan


async def _answer(scope: Any, send: Any, status: int, reason: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": f"{reason}\n".encode()})


def _line(error: BaseException | None) -> str:
    return ascii(" ".join(f"{type(error).__name__}: {error}".split())[:200])[1:-1]


def one_line_each() -> None:
    """Make gradio and the server write a line where they would write a traceback."""
    import gradio.queueing
    import gradio.routes

    def print_exc(*_: Any, **__: Any) -> None:
        log.warning("request failed: %s", _line(sys.exc_info()[1]))

    vars(gradio.queueing)["traceback"] = SimpleNamespace(print_exc=print_exc)
    vars(gradio.routes)["traceback"] = SimpleNamespace(print_exc=lambda: None)  # the gate says it
    for name in ("uvicorn.error", "asyncio"):
        logging.getLogger(name).addFilter(_shorten)
    logging.getLogger("python_multipart").setLevel(logging.ERROR)  # the answer's line says the same


def _shorten(record: logging.LogRecord) -> bool:
    if record.exc_info:
        words = record.getMessage().splitlines() or [""]
        record.msg, record.args = f"{words[0].strip()} ({_line(record.exc_info[1])})", ()
        record.exc_info = record.exc_text = None
    return True
