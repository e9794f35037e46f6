"""What the benchmarks share: commands in processes of their own, the demo's dataset, and the machine."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snerg.core.study.machine import describe_machine, machine_line

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "bench"


# On Linux the peak memory of a child includes that of its parent at the fork: a small process in between keeps the benchmark's own out.
WATCH = """
import subprocess, sys
code = subprocess.call(sys.argv[1:])
try:
    import resource
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(used.ru_maxrss, used.ru_utime + used.ru_stime)
except ImportError:
    print(0, 0)
sys.exit(code)
"""


@dataclass(frozen=True)
class Watched:
    """A command that ran: its result, its seconds from start to end, and, None where the system does not say, its peak memory and the
    seconds that its processor cores worked for it."""

    result: dict[str, Any]
    seconds: float
    megabytes: float | None
    processor: float | None


def watched(*arguments: str) -> Watched:
    """Run a command in a process of its own."""
    command = [sys.executable, "-m", "snerg.core.start", *arguments, "--json"]
    began = time.monotonic()
    child = subprocess.run([sys.executable, "-S", "-c", WATCH, *command], stdout=subprocess.PIPE, text=True)
    seconds = time.monotonic() - began
    if child.returncode != 0:
        raise SystemExit(f"'snerg {' '.join(arguments)}' failed with code {child.returncode}.")
    *_, result, used = child.stdout.splitlines()
    most, processor = map(float, used.split())
    return Watched(json.loads(result), seconds, most * (1 if sys.platform == "darwin" else 1024) / 1e6 or None, processor or None)


def snerg(*arguments: str) -> tuple[dict[str, Any], float | None]:
    """Run a command in a process of its own; returns its result and its peak memory in GB (None where the system does not say)."""
    ran = watched(*arguments)
    return ran.result, None if ran.megabytes is None else round(ran.megabytes / 1e3, 2)


def demo(out: Path) -> Path:
    """The folder of the demo's dataset, which is rendered if it is not there."""
    dataset = out / "demo" / "dataset"
    if not dataset.is_dir():
        subprocess.run([sys.executable, str(ROOT / "demo" / "run.py"), "--dataset-only", "--out", str(dataset.parent)], check=True)
    return dataset


def described() -> dict[str, Any]:
    """`describe_machine`, and the devices of JAX, from a process of its own, because JAX reserves a GPU's memory."""
    return describe_machine() | {"devices": snerg("info", "--devices")[0]}


def on_machine(machine: dict[str, Any]) -> str:
    """The value of `described` in a sentence or two."""
    return f"{machine_line(machine)} {machine['devices']['training']}"


def markdown(columns: str, rows: list[list[Any]]) -> str:
    """A Markdown table. columns: titles separated by ', '. rows: cells, None for a dash."""
    titles = columns.split(", ")
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join('—' if cell is None else str(cell) for cell in line)} |" for line in lines)
