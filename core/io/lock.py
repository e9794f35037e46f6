"""One writer a result: a lock beside it, which the system releases when its process ends, however it ends."""

from __future__ import annotations

import contextlib
import errno
import functools
import inspect
import json
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from ..errors import SnergError
from .files import cannot_write

HELD = {errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK, errno.EDEADLK}  # what systems answer where another process has the lock
BEYOND = 2**20  # the byte that is locked on Windows, where nobody else can read what is locked: it lies behind the text
MAX_TEXT = 4096  # bytes of a lock file that are read
P = ParamSpec("P")
R = TypeVar("R")
_held: dict[int, Path] = {}  # lock files of this process by their open descriptors
PATIENCE = 0.5  # seconds to wait for a first writer that has not written yet who it is, or is just about to end


@contextlib.contextmanager
def one_writer(path: Path, doing: str) -> Iterator[None]:
    """Be the only writer of the result at `path` meanwhile; `doing` says as what, such as 'a training'.

    The lock is on the hidden file .NAME.lock beside `path`, which says who has it and is deleted at the end. A kill leaves the file
    but not the lock, so that the next writer takes it over. On a disk that has no locks nobody is kept out.
    Raises SnergError when another process or thread writes there, naming it, or when the lock file cannot be written.
    """
    path = Path(os.path.realpath(path))  # through a link: both names are of one result
    file = path.with_name(f".{path.name}.lock")
    made = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
    try:
        descriptor = _acquire(file, path)
        try:
            about = {"pid": os.getpid(), "host": platform.node(), "doing": doing, "since": time.time()}
            os.ftruncate(descriptor, 0)
            os.write(descriptor, json.dumps(about).encode())
        except OSError:
            _release(descriptor, file)
            raise
    except OSError as error:
        _remove_empty(made)
        raise cannot_write(path, error) from error
    _held[descriptor] = file
    try:
        yield
    finally:
        del _held[descriptor]
        _release(descriptor, file)
        _remove_empty(made)


def writes_out(doing: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Make a function the one writer of what its argument `out` names, while it runs; None names nothing. Raises as `one_writer`."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def locked(*args: P.args, **kwargs: P.kwargs) -> R:
            out = signature.bind(*args, **kwargs).arguments.get("out")
            with contextlib.nullcontext() if out is None else one_writer(out, doing):
                return function(*args, **kwargs)

        return locked

    return decorate


def _acquire(file: Path, path: Path) -> int:
    """The open lock file, locked. Raises SnergError when another has it, OSError when it cannot be opened."""
    end = time.monotonic() + PATIENCE
    while True:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(file, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0), 0o644)
        except FileNotFoundError:  # another removed the empty parent just now
            if time.monotonic() > end:
                raise
            continue
        try:
            if try_lock(descriptor) and _is_at(descriptor, file):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
        if time.monotonic() > end:
            raise SnergError(f"{path} is being written by {_holder(file)}; wait for it or stop it.")
        time.sleep(0.02)


def try_lock(descriptor: int) -> bool:
    """Take the lock of an open file without waiting; False where another has it. On a disk that has no locks everybody gets it."""
    try:
        if os.name == "nt":
            import msvcrt

            os.lseek(descriptor, BEYOND, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
            os.lseek(descriptor, 0, os.SEEK_SET)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in HELD
    return True


def _is_at(descriptor: int, file: Path) -> bool:
    """Whether an open file is still the one at `file`: the writer before deletes it while others may have opened it."""
    try:
        there = file.stat()
    except FileNotFoundError:
        return False
    return os.path.samestat(os.fstat(descriptor), there)


def _release(descriptor: int, file: Path) -> None:
    """Delete the lock file, then let go of it; Windows cannot delete what is open."""
    if os.name != "nt":
        with contextlib.suppress(OSError):
            file.unlink()
    os.close(descriptor)
    if os.name == "nt":
        with contextlib.suppress(OSError):
            file.unlink()


def remove_locks() -> None:
    """Delete the lock files of this process, which ends in the middle of its work."""
    for file in list(_held.values()):
        with contextlib.suppress(OSError):
            file.unlink()


def _remove_empty(folders: list[Path]) -> None:
    """Remove parents that were made for the lock and hold nothing."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def _read(file: Path) -> dict[str, Any] | None:
    try:
        with open(file, "rb") as opened:
            value = json.loads(opened.read(MAX_TEXT))
    except (OSError, ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def _holder(file: Path) -> str:
    """Who has a lock, for people."""
    about = _read(file) or {}
    try:
        since = time.strftime("%H:%M", time.localtime(float(about["since"])))
        doing, pid, host = str(about["doing"])[:40], int(about["pid"]), str(about["host"])[:80]
    except (KeyError, TypeError, ValueError, OverflowError, OSError):
        return "another process"
    return f"{doing} that was started at {since} (process {pid} on {host})"
