"""Servers that answer as much of MLflow's and of Weights & Biases' interfaces as a run's start needs, then go away."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Answer = Callable[[str, dict[str, Any]], tuple[int, dict[str, Any]] | None]
"""From path and body to status and answer; None: the server is gone from now on."""


@contextmanager
def serving(answer: Answer) -> Iterator[str]:
    """Yield the address of a server that answers in this way."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            try:
                body = json.loads(self.rfile.read(int(self.headers.get("content-length") or 0)) or b"{}")
            except ValueError:
                body = {}
            found = None if gone.is_set() else answer(self.path, body if isinstance(body, dict) else {})
            if found is None:
                if not gone.is_set():
                    gone.set()
                    threading.Thread(target=stop).start()
                self.close_connection = True
                return
            content = json.dumps(found[1]).encode()
            self.send_response(found[0])
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST

        def log_message(self, *_: Any) -> None: ...

    gone = threading.Event()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)

    def stop() -> None:
        server.shutdown()
        server.server_close()

    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        if not gone.is_set():
            stop()


def mlflow_until_metrics(path: str, body: dict[str, Any]) -> tuple[int, dict[str, Any]] | None:
    """Answer as MLflow until the first metric is logged."""
    if path.split("?")[0].endswith("experiments/get-by-name"):
        return 200, {"experiment": {"experiment_id": "7", "name": "hudepth", "lifecycle_stage": "active"}}
    if path.endswith("runs/create"):
        info = {"run_id": "abc", "experiment_id": "7", "status": "RUNNING", "artifact_uri": "mlflow-artifacts:/7/abc"}
        return 200, {"run": {"info": info, "data": {}}}
    if path.endswith("runs/log-batch") and not body.get("metrics"):
        return 200, {}
    return None


def mlflow_of_a_faster_job() -> Answer:
    """Answer as MLflow where another job makes the experiment after this one looked for it."""
    looked: list[str] = []

    def answer(path: str, body: dict[str, Any]) -> tuple[int, dict[str, Any]] | None:
        if "experiments/get-by-name" in path and not looked:
            looked.append(path)
            return 404, {"error_code": "RESOURCE_DOES_NOT_EXIST", "message": "no such experiment"}
        if path.endswith("experiments/create"):
            return 400, {"error_code": "RESOURCE_ALREADY_EXISTS", "message": "there is one"}
        return mlflow_until_metrics(path, body) or (200, {})

    return answer


def wandb_until_values(path: str, body: dict[str, Any]) -> tuple[int, dict[str, Any]] | None:
    """Answer as Weights & Biases until the first values arrive."""
    query = str(body.get("query", ""))
    if "upsertBucket" in query:
        project = {"id": "p", "name": "hudepth", "entity": {"id": "e", "name": "me"}}
        name = body["variables"]["name"]  # chosen by the client
        bucket = {"id": "r", "name": name, "displayName": name, "project": project, "historyLineCount": 0}
        return 200, {"data": {"upsertBucket": {"bucket": bucket, "inserted": True}}}
    if "viewer" in query:
        viewer = {"id": "v", "username": "me", "entity": "me", "flags": "{}", "teams": {"edges": []}}
        return 200, {"data": {"viewer": viewer}}
    return None if path.endswith("file_stream") else (200, {"data": {}})
