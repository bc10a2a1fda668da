"""Serve the page on this machine until Ctrl-C; no other machine is contacted."""

from __future__ import annotations

import atexit
import contextlib
import gc
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hudepth.base.errors import ConfigError
from hudepth.demo.answers import Answer, Limits
from hudepth.demo.gate import guarded, one_line_each
from hudepth.demo.session_files import Files, draw_examples
from hudepth.inference.model_info import ModelInfo

SILENCE = {
    "GRADIO_ANALYTICS_ENABLED": "False",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "HF_HUB_OFFLINE": "1",
    "DO_NOT_TRACK": "1",
    "FASTAPI_OTEL_AUTO_CONFIGURE": "false",
}
"""Settings that keep gradio and its dependencies from sending telemetry."""


def free_port(host: str, port: int) -> int:
    """Return ``port``, or a free one for 0; raises ConfigError if it is taken or the host not one of this machine."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as trial:
            if os.name == "posix":  # on Windows it would let two programs share a port
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((host, port))
            return int(trial.getsockname()[1])
    except socket.gaierror:
        raise ConfigError(f"host: no address '{host}'. Pass host=127.0.0.1, or 0.0.0.0 for all networks.") from None
    except OSError as error:
        fix = "Pass another port=, or port=0 for any free one."
        raise ConfigError(f"port: {host}:{port} is not available ({error.strerror}). {fix}") from None


def serve(
    compute: Callable[[Path, str | None], Answer],
    *,
    host: str,
    port: int,
    limits: Limits,
    info: ModelInfo,
    camera: str,
    ready: Callable[[str], None],
    allowed_hosts: frozenset[str] = frozenset(),
) -> None:
    """Serve the page until the process is interrupted or terminated; raises ConfigError if the port is taken.

    Args:
        compute: predicts an uploaded file, for the camera that its visitor chose or None; raises HudepthError with one
            line for the page.
        host: address to listen on.
        port: to listen on; 0 takes a free one.
        limits: the largest picture that is accepted.
        info: of the model.
        camera: which is meant to have taken the pictures unless a visitor chooses another, in words.
        ready: called with the page's address once it responds.
        allowed_hosts: names by which requests may call this machine, besides ``localhost`` and its address.
    """
    port = free_port(host, port)
    atexit.register(gc.freeze)  # skips a last garbage collection of all of gradio: two seconds
    with Files(limits.kept_bytes) as files, _ended_by_signals() as ended:
        _silence(files.uploads)
        from hudepth.demo import page

        blocks: Any = page.build(compute, files, draw_examples(files.examples), info=info, camera=camera)
        try:
            _, address, _ = blocks.launch(
                server_name=host, server_port=port, share=False, inbrowser=False, prevent_thread_lock=True, quiet=True,
                show_error=True, max_file_size=limits.upload_bytes, ssr_mode=False, mcp_server=False, pwa=False,
                enable_monitoring=False, run_history=False, footer_links=[], theme=page.THEME,
                css=page.data_file("viewer.css"),
                app_kwargs={"lifespan": guarded(files, allowed_hosts | {host.lower()}, limits.upload_bytes)},
            )  # fmt: skip
            one_line_each()
            ready(address.rstrip("/"))
            ended.wait()
        finally:  # at once: the server would wait for open pages, and log an error when interrupted
            logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
            if blocks.server is not None:
                blocks.server.force_exit = True
            blocks.close(verbose=False)


def _silence(uploads: Path) -> None:
    """Set what gradio reads on import: the folder of uploads, and no telemetry."""
    os.environ.update(SILENCE, GRADIO_TEMP_DIR=str(uploads))
    for name in ("NO_PROXY", "no_proxy"):  # gradio requests its own page once, which no proxy can reach
        os.environ[name] = ",".join(filter(None, [os.environ.get(name), "127.0.0.1", "localhost"]))
    if (runtime := sys.modules.get("onnxruntime")) is not None and hasattr(runtime, "disable_telemetry_events"):
        runtime.disable_telemetry_events()


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set, for an orderly shutdown."""
    ended = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield ended
        return
    before = {number: signal.signal(number, lambda *_: ended.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield ended
    finally:
        for number, old in before.items():
            signal.signal(number, old)
