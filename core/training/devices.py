"""The devices that training runs on: those of this machine, or of several machines together. JAX is imported only inside functions."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from typing import Any

from ..errors import SnergError

MISSING = "JAX is not installed in this Python, so it can neither train nor bake: run 'pip install jax' (on NVIDIA 'jax[cuda12]')."
PATIENCE = 120  # seconds to wait for the other processes


def connect(coordinator: str, processes: int, process: int) -> None:
    """Join the other processes of a distributed training (jax.distributed.initialize). Call it before any other use of JAX.

    coordinator: HOST:PORT of process 0; processes: the number of processes; process: the index of this one, from 0. All processes read
    the same dataset and folder; only process 0 writes. Raises SnergError when an argument is invalid, JAX is missing, or the other
    processes do not join in time.
    """
    if not re.fullmatch(r"\S+:\d{1,5}", coordinator) or not 0 < int(coordinator.rsplit(":", 1)[1]) < 2**16:
        raise SnergError(f"The coordinator is {coordinator!r}; give the host and port of process 0, such as 192.168.0.10:8476.")
    if processes < 1 or not 0 <= process < processes:
        raise SnergError(f"Process {process} of {processes} makes no sense; number {max(processes, 1)} processes from 0.")
    if processes == 1:
        return
    try:
        import jax
    except ImportError as error:
        raise SnergError(MISSING) from error
    try:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")  # GPUs have their own
        bound = own_address(coordinator)
        jax.distributed.initialize(coordinator, processes, process, initialization_timeout=PATIENCE, coordinator_bind_address=bound)
    except Exception as error:  # whatever it is that keeps them apart, JAX has no type of its own for it
        problem = f"Process {process} cannot join the others at {coordinator} ({_first_line(error)})"
        raise SnergError(f"{problem}; start all of them, and check the port.") from error


def own_address(coordinator: str) -> str | None:
    """The one address to listen at, where HOST is an address of this machine, or localhost; None, for all of them, where it is a name
    or an address that the network translates: others may reach it at another than this machine thinks."""
    host, port = coordinator.rsplit(":", 1)
    host = "127.0.0.1" if host == "localhost" else host.strip("[]")
    try:
        family = socket.AF_INET6 if ipaddress.ip_address(host).version == 6 else socket.AF_INET
        with socket.socket(family) as tried:
            tried.bind((host, 0))
    except (OSError, ValueError):
        return None
    return f"[{host}]:{port}" if family == socket.AF_INET6 else f"{host}:{port}"


def device_report() -> dict[str, Any]:
    """The devices that a training would use, as JSON values: {"jax", "platform", "devices", "processes", "cores", "training"}.

    devices: [{"kind", "memory_gb"}], memory_gb None where JAX does not report it; training: a sentence for the user. Where JAX is
    missing or finds no working device, jax or platform is None and the sentence gives the remedy.
    """
    report: dict[str, Any] = {"jax": None, "platform": None, "devices": [], "processes": 1, "cores": os.cpu_count()}
    try:
        import jax
    except ImportError:
        return report | {"training": MISSING}
    report["jax"] = jax.__version__
    try:
        devices = jax.devices()
    except RuntimeError as error:
        return report | {"training": f"JAX finds no device that works ({_first_line(error)}); check its installation and JAX_PLATFORMS."}
    platform, count, processes = devices[0].platform, len(devices), jax.process_count()
    report |= {
        "platform": platform,
        "devices": [{"kind": device.device_kind, "memory_gb": _memory(device)} for device in devices],
        "processes": processes,
    }
    if platform == "cpu" and count == 1:
        sentence = f"Training uses this machine's processor, {report['cores']} cores."
    elif count == 1:
        sentence = f"Training uses one device, {devices[0].device_kind} ({platform})."
    else:
        where = f" in {processes} processes" if processes > 1 else ""
        sentence = f"Training divides each step among {count} devices{where}: {_counted([d.device_kind for d in devices])} ({platform})."
    return report | {"training": sentence}


def _memory(device: Any) -> float | None:
    """Gigabytes, where the device is ours to ask and says so."""
    try:
        stats = device.memory_stats()
    except Exception:  # another process's device, or a platform that has no such thing
        return None
    limit = (stats or {}).get("bytes_limit")
    return None if limit is None else round(limit / 1e9, 1)


def _counted(kinds: list[str]) -> str:
    return ", ".join(f"{kinds.count(kind)} x {kind}" for kind in dict.fromkeys(kinds))


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
