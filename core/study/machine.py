"""The machine that a measurement ran on, and the peak memory of this process."""

from __future__ import annotations

import os
import platform
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("numpy", "jax", "pillow")  # whose versions are recorded
POLL_SECONDS = 0.02  # between readings of the memory: shorter peaks are missed
STATUS = Path("/proc/self/statm")  # Linux; its second number is the resident memory in pages


def describe_machine() -> dict[str, Any]:
    """{"processor", "cores", "memory_gb" (None where the system does not say), "system", "python", and the version of each package}."""
    processor, memory = platform.processor() or platform.machine(), None
    if sys.platform == "linux":
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), processor)
        memory = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    about = {"processor": processor, "cores": cores, "memory_gb": memory, "system": platform.platform(terse=True)}
    return about | {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES}


def machine_line(machine: dict[str, Any]) -> str:
    """The value of `describe_machine` in a sentence."""
    memory = f"{machine['memory_gb']} GB" if machine["memory_gb"] else "memory unknown"
    return (
        f"{machine['processor']}, {machine['cores']} cores, {memory}; {machine['system']}; Python {machine['python']}, "
        f"NumPy {machine['numpy']}, JAX {machine['jax']}."
    )


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


class Peak:
    """The peak memory of this process."""

    most: int | None = None  # bytes; None where the system does not say


@contextmanager
def watched() -> Iterator[Peak]:
    """Measure the peak resident memory of this process inside the `with` block."""
    peak, done = Peak(), threading.Event()

    def poll() -> None:
        page = os.sysconf("SC_PAGE_SIZE")
        while True:
            peak.most = max(peak.most or 0, int(STATUS.read_text().split()[1]) * page)
            if done.wait(POLL_SECONDS):
                return

    if not STATUS.exists():
        yield peak
        return
    thread = threading.Thread(target=poll, daemon=True)
    thread.start()
    try:
        yield peak
    finally:
        done.set()
        thread.join()
