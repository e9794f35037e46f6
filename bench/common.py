"""What the benchmarks share: verbs in processes of their own, the demo's scene, and the machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from snerg.core.study.machine import describe_machine, machine_line

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "bench"


def snerg(*arguments: str) -> tuple[dict[str, Any], float | None]:
    """Run a verb in a process of its own; returns its result and its peak memory in GB (None where the system does not say)."""
    command = [sys.executable, "-m", "snerg.core.cli", *arguments, "--json"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    output, peak = child.stdout.read(), None
    if hasattr(os, "wait4"):
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        peak = round(usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9, 2)
    if child.wait() != 0:
        raise SystemExit(f"'snerg {' '.join(arguments)}' failed with code {child.returncode}.")
    return json.loads(output.splitlines()[-1]), peak


def demo(out: Path) -> Path:
    """The demo's scene, rendered once."""
    dataset = out / "demo" / "dataset"
    if not dataset.is_dir():
        subprocess.run([sys.executable, str(ROOT / "demo" / "run.py"), "--dataset-only", "--out", str(dataset.parent)], check=True)
    return dataset


def described() -> dict[str, Any]:
    """`describe_machine`, and what JAX trains on: asked in a process of its own, because JAX keeps a GPU's memory to itself."""
    return describe_machine() | {"devices": snerg("info", "--devices")[0]}


def on_machine(machine: dict[str, Any]) -> str:
    """What `described` says, in a sentence or two."""
    return f"{machine_line(machine)} {machine['devices']['training']}"


def markdown(columns: str, rows: list[list[Any]]) -> str:
    """A table: columns with commas between them, and rows of cells."""
    titles = columns.split(", ")
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join('—' if cell is None else str(cell) for cell in line)} |" for line in lines)
