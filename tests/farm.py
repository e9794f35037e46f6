"""Flamenco's part in the tests: its Manager compiles a job, and its Worker runs the tasks one after the other.

The Manager and the Worker are no packages of a registry: flamenco.mjs restates by which rules the one compiles, and `arguments` what the
other starts.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
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
    assert command["name"] == "blender-render", command
    before = [*shlex.split(filled(given["exeArgs"])), *given["argsBefore"]]
    return [filled(given["exe"]), *map(filled, [*before, given["blendfile"], *given["args"]])]


def filled(text: str) -> str:
    """A text with the Manager's variables."""
    return text.replace("{blenderArgs}", "-b -y").replace("{blender}", "blender")
