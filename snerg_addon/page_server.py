"""A web server inside Blender that shows an exported page to this computer: a page of many files cannot be opened from the disk."""

from __future__ import annotations

import functools
import http.server
import threading
from pathlib import Path

_servers: dict[Path, http.server.ThreadingHTTPServer] = {}


class _Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files, prints nothing, and lets no browser show an earlier export."""

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def log_message(self, *_: object) -> None:
        pass


def address_of(folder: Path) -> str:
    """The address of a page's folder, for programs of this computer alone; it holds until Blender closes. Raises OSError."""
    if folder not in _servers:
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Quiet, directory=str(folder)))
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, name="SNeRG page", daemon=True).start()
        _servers[folder] = server
    return f"http://127.0.0.1:{_servers[folder].server_port}/"


def stop() -> None:
    """Stop all servers."""
    while _servers:
        _, server = _servers.popitem()
        server.shutdown()
        server.server_close()
