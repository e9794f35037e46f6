"""Flamenco's part in the tests: its Manager compiles a job, and its Worker runs the tasks one after the other.

The Manager and the Worker are no packages of a registry: flamenco.mjs restates by which rules the one compiles, and `arguments` what the
other starts.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "farm" / "snerg.js"


def compiled(**settings: Any) -> dict[str, Any]:
    """{"type", "settings", "tasks"} of a job with these settings. Raises ValueError with what the job type throws."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node compiles the job type, and is not here")
    job = json.dumps({"name": "A job", "settings": settings})
    result = subprocess.run([node, str(ROOT / "tests" / "flamenco.mjs"), str(SCRIPT)], input=job, capture_output=True, text=True)
    if result.returncode:
        raise ValueError(result.stderr.strip())
    value: dict[str, Any] = json.loads(result.stdout)
    return value


def arguments(command: dict[str, Any]) -> list[str]:
    """The program and the arguments that a Worker starts for a command, with the Manager's default variables."""
    given = {**command["parameters"]}
    if command["name"] == "exec":
        return [filled(given["exe"]), *map(filled, given["args"])]
    if command["name"] == "frames-to-video":
        rate = ["-r", f"{given['fps']:g}"]
        return [given["exe"], *rate, "-pattern_type", "glob", "-i", given["inputGlob"], *given["args"], *rate, given["outputFile"]]
    assert command["name"] == "blender-render", command
    before = [*shlex.split(filled(given["exeArgs"])), *given["argsBefore"]]
    return [filled(given["exe"]), *map(filled, [*before, given["blendfile"], *given["args"]])]


def filled(text: str) -> str:
    """A text with the Manager's variables."""
    return text.replace("{blenderArgs}", "-b -y").replace("{blender}", "blender")


class Server(HTTPServer):
    """Stands in for a Manager. jobs: (what was sent, what it was compiled to); known: whether it has the job type."""

    def __init__(self, storage: Path) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.jobs: list[tuple[dict[str, Any], dict[str, Any]]] = []
        self.known, self.storage, self.url = True, str(storage), f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    """The part of the Manager's HTTP interface, version 3, that is used."""

    server: Server

    def do_GET(self) -> None:
        paths: dict[str, Any] = {"/api/v3/version": {"version": "3.7.0", "shortversion": "3.7", "name": "Flamenco", "git": ""}}
        paths["/api/v3/configuration/shared-storage/users/linux"] = {"location": self.server.storage, "audience": "users"}
        if self.server.known:
            paths["/api/v3/jobs/type/snerg"] = {"name": "snerg", "label": "SNeRG", "etag": "abc", "settings": []}
        found = paths.get(self.path)
        self.answer(200 if found else 404, found or {"code": 404, "message": "no such job type known"})

    def do_POST(self) -> None:
        job = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        assert self.path == "/api/v3/jobs" and {"name", "type", "priority", "submitter_platform"} <= job.keys()
        if job["type_etag"] != "abc":
            return self.answer(412, {"code": 412, "message": "rejecting job because its settings are outdated"})
        try:
            made = compiled(**job["settings"])
        except ValueError as error:
            return self.answer(400, {"code": 400, "message": f"error compiling job: {error}"})
        self.server.jobs.append((job, made))
        return self.answer(200, {**job, "id": "0123", "status": "queued"})

    def answer(self, code: int, value: dict[str, Any]) -> None:
        self.send_response(code)
        self.end_headers()
        self.wfile.write(json.dumps(value).encode())

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def a_manager(storage: Path) -> Iterator[Server]:
    """A server that answers as a Manager does, and compiles what it is sent. storage: the farm's shared folder."""
    with Server(storage) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
