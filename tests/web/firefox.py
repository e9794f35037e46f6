"""Firefox itself, driven by the protocol that it speaks (Marionette, which geckodriver passes WebDriver's commands on to)."""

from __future__ import annotations

import base64
import io
import json
import os
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ELEMENT = "element-6066-11e4-a52e-4f735466cecf"  # WebDriver's key of an element
PREFERENCES = {
    "marionette.port": 0,
    "app.normandy.enabled": False,
    "app.update.enabled": False,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "dom.ipc.processCount": 1,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "toolkit.telemetry.enabled": False,
    "webgl.force-enabled": True,
    "layout.css.devPixelsPerPx": "1",
}
SECONDS = 60  # that Firefox has to start, and a command to answer
CANVAS = """
const canvas = document.querySelector("snerg-viewer").shadowRoot.getElementById("canvas");
canvas.blur(); // the ring of the focus lies over the picture's border
return canvas;
"""


class Firefox:
    """A Firefox without a window, and one tab of it. Close it."""

    def __init__(self, binary: str, profile: Path, size: tuple[int, int], display: str) -> None:
        lines = [f"user_pref({json.dumps(name)}, {json.dumps(value)});" for name, value in PREFERENCES.items()]
        (profile / "user.js").write_text("\n".join(lines))
        command = [binary, "--headless", "--no-remote", "--marionette", "--profile", str(profile)]
        command += [f"--width={size[0]}", f"--height={size[1]}", "about:blank"]
        environment = {**os.environ, "DISPLAY": display}  # it has no window there, but WebGL takes its OpenGL
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
        self.number = 0
        try:
            self.socket = self._connect(profile / "MarionetteActivePort")
            self._receive()  # a greeting
            self.command("WebDriver:NewSession", {"capabilities": {"alwaysMatch": {}}})
            self.command("WebDriver:SetTimeouts", {"script": 1000 * SECONDS})
            self.command("WebDriver:SetWindowRect", {"width": size[0], "height": size[1]})
        except BaseException:
            self.process.kill()
            raise

    def _connect(self, port: Path) -> socket.socket:
        for _ in range(10 * SECONDS):
            time.sleep(0.1)
            if port.exists() and port.read_text().strip().isdigit():
                return socket.create_connection(("127.0.0.1", int(port.read_text())), timeout=2 * SECONDS)
            if self.process.poll() is not None:
                break
        raise RuntimeError("Firefox does not start")

    def close(self) -> None:
        self.socket.close()
        self.process.terminate()
        self.process.wait(30)

    def command(self, name: str, parameters: dict[str, Any]) -> Any:
        """The value of a command of WebDriver. Raises RuntimeError with Firefox's words."""
        self.number += 1
        data = json.dumps([0, self.number, name, parameters]).encode()
        self.socket.sendall(f"{len(data)}:".encode() + data)
        _, number, error, value = self._receive()
        assert number == self.number
        if error:
            raise RuntimeError(f"{name}: {error.get('message')}")
        return value["value"] if isinstance(value, dict) and set(value) == {"value"} else value

    def _receive(self) -> Any:
        length = b""
        while not length.endswith(b":"):
            length += self._read(1)
        return json.loads(self._read(int(length[:-1])))

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.socket.recv(count - len(data))
            if not part:
                raise RuntimeError("Firefox has ended")
            data += part
        return data

    def open(self, address: str) -> str | None:
        """Open a page and wait until it shows its scene or says why not, which is returned."""
        self.command("WebDriver:Navigate", {"url": "about:blank"})
        self.command("WebDriver:Navigate", {"url": address})
        self.wait("window.snerg.ready")
        return self.evaluate("window.snerg.problem")

    def evaluate(self, expression: str) -> Any:
        return self.command("WebDriver:ExecuteScript", {"script": f"return {expression}", "args": [], "newSandbox": False, "sandbox": None})

    def wait(self, expression: str) -> Any:
        """The value of a promise."""
        script = f"const done = arguments[arguments.length - 1]; Promise.resolve({expression}).then(done, (error) => done(String(error)))"
        return self.command("WebDriver:ExecuteAsyncScript", {"script": script, "args": [], "newSandbox": False, "sandbox": None})

    def picture(self) -> np.ndarray:
        """What the canvas shows, float64 [H, W, 3] in [0, 1]."""
        self.wait("window.snerg.settled()")
        canvas = self.command("WebDriver:ExecuteScript", {"script": CANVAS, "args": [], "newSandbox": False, "sandbox": None})
        shot = self.command("WebDriver:TakeScreenshot", {"id": canvas[ELEMENT], "full": False, "hash": False})
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB")) / 255

    def act(self, kind: str, actions: Sequence[dict[str, Any]], **more: Any) -> None:
        """Input of a device: "key", "pointer" or "wheel", as WebDriver's actions."""
        self.command("WebDriver:PerformActions", {"actions": [{"type": kind, "id": kind, "actions": list(actions), **more}]})

    def press(self, key: str) -> None:
        self.act("key", [{"type": "keyDown", "value": key}, {"type": "keyUp", "value": key}])

    def drag(self, begin: tuple[int, int], end: tuple[int, int], pointer: str = "mouse") -> None:
        move = [{"type": "pointerMove", "duration": 100 * i, "x": x, "y": y} for i, (x, y) in enumerate((begin, end))]
        down, up = {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}
        self.act("pointer", [move[0], down, move[1], up], parameters={"pointerType": pointer})

    def wheel(self, place: tuple[int, int], lines: int) -> None:
        self.act("wheel", [{"type": "scroll", "x": place[0], "y": place[1], "deltaX": 0, "deltaY": lines, "duration": 0}])


@contextmanager
def display() -> Iterator[str]:
    """The address of an X display: the one that is there, or Xvfb's, which chooses a free number."""
    if os.environ.get("DISPLAY"):
        yield os.environ["DISPLAY"]
        return
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "800x700x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        yield f":{server.stdout.readline().strip()}"
        server.terminate()
