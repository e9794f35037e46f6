"""What the benchmarks share: verbs in processes of their own, the demo's scene, and the machine."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

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


def describe_machine() -> dict[str, Any]:
    """The processor, its memory, what JAX trains on, and the versions."""
    devices = json.loads(
        subprocess.run(  # in a process of its own: JAX keeps a GPU's memory to itself
            [sys.executable, "-m", "snerg.core.cli", "info", "--devices", "--json"], capture_output=True, text=True, check=True
        ).stdout.splitlines()[-1]
    )
    processor, memory = platform.processor() or platform.machine(), None
    if sys.platform == "linux":
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), processor)
        memory = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    return {
        "processor": processor,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gb": memory,
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "jax": version("jax"),
        "devices": devices,
    }


def machine_line(machine: dict[str, Any]) -> str:
    """The machine in a sentence or two."""
    memory = f"{machine['memory_gb']} GB" if machine["memory_gb"] else "memory unknown"
    return (
        f"{machine['processor']}, {machine['cores']} cores, {memory}; {machine['system']}; Python {machine['python']}, "
        f"NumPy {machine['numpy']}, JAX {machine['jax']}. {machine['devices']['training']}"
    )


def markdown(columns: str, rows: list[list[Any]]) -> str:
    """A table: columns with commas between them, and rows of cells."""
    titles = columns.split(", ")
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join('—' if cell is None else str(cell) for cell in line)} |" for line in lines)
