"""A full Blender, named by the environment's BLENDER, with the extension installed from its zip into a user folder of the tests' own.

Everything lies under build/window, which a Blender in a container sees too when it sees the repository: the zip, the user
folder, and for each walk its console output, what it saw (JSON) and its screenshots.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from scenes import make_dataset

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
OUT = ROOT / "build" / "window"
SCREEN = ["xvfb-run", "-a", "-s", "-screen 0 1600x900x24"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Every test of this folder wants a full Blender: `make test` leaves them out."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.window)


@dataclass(frozen=True)
class Blender:
    """program: what starts it."""

    program: str

    def run(self, *arguments: str, screen: bool = False, seconds: float = 1200, stop: str = "") -> subprocess.CompletedProcess[str]:
        """Run it to its end. screen: with a window. stop: press Ctrl-C once this was printed on standard error."""
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(OUT / "user"), "PYTHONPATH": "", "PYTHONUNBUFFERED": "1"}
        command = [*(SCREEN if screen and needs_screen() else []), self.program, *arguments]
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        process = subprocess.Popen(command, env=environment, cwd=OUT, start_new_session=True, **pipes)
        try:
            early = stopped(process, stop) if stop else ""
            out, err = process.communicate(timeout=seconds)
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            raise
        return subprocess.CompletedProcess(command, process.returncode, out, early + err)

    def snerg(self, *arguments: str, stop: str = "") -> subprocess.CompletedProcess[str]:
        """`blender --command snerg ...`"""
        return self.run("--command", "snerg", *arguments, stop=stop)

    def folder(self, name: str) -> Path:
        """Where a walk leaves what it saw."""
        return OUT / name

    def walk(self, name: str, *arguments: object, seconds: float = 1200) -> dict[str, Any]:
        """Start it with a window, do what the function `name` of walks.py does there, and return what that saw.

        The console's output, the JSON and the screenshots stay in build/window/NAME.
        """
        folder = self.folder(name)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return self.walk_on(name, folder, *arguments, seconds=seconds)

    def walk_on(self, name: str, folder: Path, *arguments: object, seconds: float = 1200) -> dict[str, Any]:
        """The same in a folder that an earlier walk has filled."""
        script = ("--enable-event-simulate", "--python", str(HERE / "drive.py"), "--", name, str(folder), *map(str, arguments))
        result = self.run(*script, screen=True, seconds=seconds)
        (folder / f"{name}.log").write_text(result.stdout + result.stderr)
        report = folder / f"{name}.json"
        assert report.is_file(), f"Blender ended during {name!r} with code {result.returncode}: {(result.stdout + result.stderr)[-2000:]}"
        seen: dict[str, Any] = json.loads(report.read_text())
        assert not seen["error"], f"The walk {name!r} did not get to its end; see {folder}: {seen['error']}"
        assert "Traceback" not in result.stdout + result.stderr, f"Blender's console shows a traceback; see {folder / name}.log"
        return seen


def stopped(process: subprocess.Popen[str], text: str) -> str:
    """Wait until `text` stands in a line of standard error, press Ctrl-C as a terminal does, and return the lines so far."""
    assert process.stderr is not None
    lines = ""
    for line in process.stderr:
        lines += line
        if text in line:
            os.killpg(process.pid, signal.SIGINT)
            break
    return lines


def needs_screen() -> bool:
    """There is no screen here, and a virtual one can be had. Where neither is so, BLENDER must bring its own."""
    return sys.platform == "linux" and not os.environ.get("DISPLAY") and shutil.which(SCREEN[0]) is not None


@pytest.fixture(scope="session")
def blender() -> Blender:
    """The full Blender with the extension; skips where there is none."""
    program = os.environ.get("BLENDER", "")
    if not program:
        pytest.skip("BLENDER names no full Blender: make test-blender BLENDER=/path/to/blender")
    if shutil.which(program) is None:
        pytest.skip(f"BLENDER is {program!r}, which is no program here")
    return with_extension(program)


def with_extension(program: str) -> Blender:
    """A Blender into whose user folder under build/window the extension was installed from a new zip."""
    for name in ("user", "zip"):
        shutil.rmtree(OUT / name, ignore_errors=True)
    OUT.mkdir(parents=True, exist_ok=True)
    build = [sys.executable, str(ROOT / "tools" / "build_extension.py"), "--no-wheels", "--out", str(OUT / "zip")]
    subprocess.run(build, check=True, capture_output=True)
    found = Blender(program)
    installed = found.run("--command", "extension", "install-file", "-r", "user_default", "-e", str(next((OUT / "zip").glob("*.zip"))))
    assert installed.returncode == 0, f"Blender did not install the extension: {installed.stdout}{installed.stderr}"
    return found


@pytest.fixture(scope="session")
def photos(blender: Blender) -> Path:
    """A small dataset where Blender sees it."""
    folder = OUT / "photos"
    shutil.rmtree(folder, ignore_errors=True)
    return make_dataset(folder)


@pytest.fixture(scope="session")
def trained(photos: Path) -> Path:
    """A field of that dataset, trained in this Python."""
    field = OUT / "trained"
    shutil.rmtree(field, ignore_errors=True)
    train = ["train", str(photos), "--out", str(field), "--steps", "40", "--view-dependence", "diffuse"]
    subprocess.run([sys.executable, str(ROOT / "launcher.py"), *train], check=True, capture_output=True)
    return field
