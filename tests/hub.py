"""A Hugging Face Hub on this machine: as much of its protocol as huggingface_hub needs to publish and load a model."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

TOKEN = "hf_of_the_owner"
COMMIT = "/api/models/{name}/commit/main"


class Hub:
    """Its models, by name: files, and whether they are private."""

    def __init__(self) -> None:
        self.files: dict[str, dict[str, bytes]] = {}
        self.private: dict[str, bool] = {}
        self.url = ""
        self.received: list[str] = []

    def commit_of(self, name: str) -> str:
        return hashlib.sha1(repr(sorted(self.files[name].items())).encode()).hexdigest()


class _Handler(BaseHTTPRequestHandler):
    hub: Hub

    def log_message(self, format: str, *args: Any) -> None:
        self.hub.received.append(format % args)

    def answer(self, status: int, body: Any = None, **headers: str) -> None:
        content = body if isinstance(body, bytes) else json.dumps(body if body is not None else {}).encode()
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def allowed(self, name: str) -> bool:
        return not self.hub.private.get(name) or self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if path == "/api/whoami-v2":
            known = self.headers.get("Authorization") == f"Bearer {TOKEN}"
            return self.answer(200, {"name": "owner"}) if known else self.answer(401, X_Error_Message="Invalid token")
        info = re.fullmatch(r"/api/models/([^/]+/[^/]+)(?:/revision/(.+))?", path)
        file = re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path)
        name, revision = (info or file or [None, "", ""])[1], (info or file or ["", "", ""])[2] or "main"  # type: ignore[index]
        if name not in self.hub.files or not self.allowed(name):
            return self.answer(401, {"error": "Repository Not Found"}, X_Error_Code="RepoNotFound")
        files, commit = self.hub.files[name], self.hub.commit_of(name)
        if revision not in ("main", commit):
            return self.answer(404, X_Error_Code="RevisionNotFound")
        if info:
            siblings = [{"rfilename": each, "size": len(content)} for each, content in files.items()]
            return self.answer(200, {"id": name, "modelId": name, "sha": commit, "siblings": siblings})
        assert file is not None
        if file[3] not in files:
            return self.answer(404, X_Error_Code="EntryNotFound", X_Repo_Commit=commit)
        etag = hashlib.sha1(files[file[3]]).hexdigest()
        return self.answer(200, files[file[3]], X_Repo_Commit=commit, ETag=f'"{etag}"')

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return self.answer(401, {"error": "Invalid token"})
        if self.path == "/api/repos/create":
            asked = json.loads(body)
            name = f"{asked.get('organization', 'owner')}/{asked['name']}"
            if asked.get("organization", "owner") != "owner":
                return self.answer(403, {"error": "You may not create a model there"})
            known = name in self.hub.files
            self.hub.files.setdefault(name, {})
            self.hub.private.setdefault(name, asked.get("visibility") == "private" or bool(asked.get("private")))
            return self.answer(409 if known else 200, {"url": f"{self.hub.url}/{name}"})
        if self.path == "/api/validate-yaml":
            return self.answer(200, {"errors": [], "warnings": []})
        name = "/".join(self.path.split("/")[3:5])
        if "/preupload/" in self.path:
            paths = [each["path"] for each in json.loads(body)["files"]]
            modes = [{"path": path, "uploadMode": "regular", "shouldIgnore": False} for path in paths]
            return self.answer(200, {"files": modes})
        assert self.path.startswith(COMMIT.format(name=name))
        for line in body.splitlines():
            each = json.loads(line)
            if each["key"] == "file":
                self.hub.files[name][each["value"]["path"]] = base64.b64decode(each["value"]["content"])
        commit = self.hub.commit_of(name)
        return self.answer(200, {"commitUrl": f"{self.hub.url}/{name}/commit/{commit}", "commitOid": commit})


@contextmanager
def serve() -> Iterator[Hub]:
    """Run a hub during the block."""
    hub = Hub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": hub}))
    hub.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
