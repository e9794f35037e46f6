"""What a measurement was taken on, and the memory that it took."""

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

PACKAGES = ("numpy", "jax", "pillow")
LOOK_SECONDS = 0.02
STATUS = Path("/proc/self/statm")


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
    """The machine in a sentence."""
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
    """The most memory, in bytes, that this process held at any time while it was watched; None where the system does not say."""

    most: int | None = None


@contextmanager
def watched() -> Iterator[Peak]:
    """Look at this process's memory now and then until the end."""
    peak, done = Peak(), threading.Event()

    def look() -> None:
        page = os.sysconf("SC_PAGE_SIZE")
        while True:
            peak.most = max(peak.most or 0, int(STATUS.read_text().split()[1]) * page)
            if done.wait(LOOK_SECONDS):
                return

    if not STATUS.exists():
        yield peak
        return
    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield peak
    finally:
        done.set()
        thread.join()
