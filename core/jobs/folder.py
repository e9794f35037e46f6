"""A job's folder, from which any process can tell what the job does and whether it runs.

`<project>/jobs/<time-ordered name>/` holds

    job.json      the record: label, step, operator, scene, command, when and where it was started
    events.jsonl  the job's standard output (see protocol.py)
    log.txt       its standard error
    stop          exists once the job was asked to stop
    lock          locked by the job's process while it runs; the system releases the lock however the process ends
    taken         exists once somebody has handled the job's result
    input         files that the job needs, deleted when it ends

`<project>/jobs/turn` is locked by the job that runs. Jobs of one project run one after another, in the order of their names.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..errors import SnergError
from ..io.files import cannot_write
from ..io.json_files import json_bytes
from ..io.lock import try_lock

VARIABLE = "SNERG_JOB"  # environment variable of a job's process: its folder
JOBS, RECORD, EVENTS, LOG, STOP, LOCK, TAKEN, TURN, INPUT = (
    "jobs",
    "job.json",
    "events.jsonl",
    "log.txt",
    "stop",
    "lock",
    "taken",
    "turn",
    "input",
)
STARTING_SECONDS = 60.0  # within which a job that was started has to lock its lock
KEPT = 20  # folders of ended and taken jobs that `prune` leaves, for their logs
MAX_RECORD = 2**24  # bytes of job.json that are read


def new_job(project: Path, record: Mapping[str, Any], prepare: Callable[[Path], None] | None = None) -> Path:
    """Make the folder of a new job, after all others in their order. It appears complete or not at all.

    record: for job.json. prepare: called with the folder before it appears, to write files that the job needs. Raises SnergError where
    the folder cannot be written.
    """
    jobs = project / JOBS
    temporary = jobs / f".new-{uuid.uuid4().hex[:8]}"
    try:
        temporary.mkdir(parents=True)
        if prepare:
            prepare(temporary)
        (temporary / RECORD).write_bytes(json_bytes({**record, "started": time.time()}))
        (temporary / EVENTS).touch()
        seconds, fraction = divmod(time.time_ns(), 10**9)
        folder = jobs / f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime(seconds))}.{fraction:09d}-{uuid.uuid4().hex[:4]}"
        os.replace(temporary, folder)
    except OSError as error:
        raise cannot_write(jobs, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    prune(project)
    return folder


def job_folders(project: Path) -> list[Path]:
    """The folders of all jobs of a project, the oldest first. Never raises."""
    try:
        names = sorted(entry.name for entry in os.scandir(project / JOBS) if entry.is_dir() and not entry.name.startswith("."))
    except OSError:
        return []
    return [project / JOBS / name for name in names if (project / JOBS / name / RECORD).is_file()]


def live_jobs(project: Path) -> list[Path]:
    """The folders of the jobs that run or wait."""
    return [folder for folder in job_folders(project) if is_alive(folder)]


def read_record(folder: Path) -> dict[str, Any]:
    """The record of a job; {} where it cannot be read. Never raises."""
    try:
        with open(folder / RECORD, "rb") as file:
            value = json.loads(file.read(MAX_RECORD))
    except (OSError, ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def label_of(folder: Path) -> str:
    """The label of a job ('Training')."""
    return str(read_record(folder).get("label", "another job"))[:80]


def is_alive(folder: Path) -> bool:
    """Whether a job's process runs, or was started less than STARTING_SECONDS ago and has not locked its lock yet."""
    lock = folder / LOCK
    try:
        if lock.stat().st_size:
            return is_held(lock)
    except OSError:
        pass
    started = read_record(folder).get("started", 0.0)
    return isinstance(started, float) and 0 <= time.time() - started < STARTING_SECONDS and not (folder / TAKEN).exists()


def take(folder: Path) -> bool:
    """Mark a job's result as taken. Returns False where it was already, so that each result is handled only once."""
    try:
        (folder / TAKEN).touch(exist_ok=False)
    except OSError:
        return False
    return True


def prune(project: Path) -> None:
    """Delete the folders of jobs that ended and were taken, except for the newest KEPT."""
    ended = [folder for folder in job_folders(project) if (folder / TAKEN).exists() and not is_alive(folder)]
    for folder in ended[:-KEPT]:
        shutil.rmtree(folder, ignore_errors=True)


def hold(path: Path) -> int | None:
    """Lock a file without waiting. Returns a descriptor that holds the lock while it is open; None where another process holds it.

    On a file system without locks every process gets one. Raises SnergError where the file cannot be opened.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)
    except OSError as error:
        raise cannot_write(path, error) from error
    if try_lock(descriptor):
        return descriptor
    os.close(descriptor)
    return None


def is_held(path: Path) -> bool:
    """Whether another process holds the lock of the file."""
    try:
        descriptor = hold(path)
    except SnergError:
        return False
    if descriptor is None:
        return True
    with contextlib.suppress(OSError):
        os.close(descriptor)
    return False
