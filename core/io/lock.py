"""A lock beside each result, so that it has one writer. The system releases the lock when the process ends, also when it is killed."""

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

HELD = {errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK, errno.EDEADLK}  # error codes when another process has the lock
LOCKED_BYTE = 2**20  # on Windows others cannot read a locked byte, so that one after the end of the text is locked
MAX_TEXT = 4096  # bytes of a lock file that are read
P = ParamSpec("P")
R = TypeVar("R")
_held: dict[int, Path] = {}  # lock files of this process by their open descriptors
WAIT_SECONDS = 0.5  # for another writer that has not yet written its name, or is about to end


@contextlib.contextmanager
def one_writer(path: Path, doing: str, patience: float = WAIT_SECONDS) -> Iterator[None]:
    """Hold the lock of the result at `path`. doing: what the lock file calls the work, such as 'a training'. patience: seconds to wait
    for another writer.

    The lock is on the hidden file .NAME.lock beside `path`, which names its holder and is deleted at the end. After a kill the file
    remains without the lock, and the next writer takes it over. A file system without locks excludes nobody.
    Raises SnergError that names the other process or thread when one writes there, or when the lock file cannot be written.
    """
    path = Path(os.path.realpath(path))  # follow a link: both names belong to one result
    file = path.with_name(f".{path.name}.lock")
    made = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
    try:
        descriptor = _acquire(file, path, patience)
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
    """A decorator: the function holds the lock of its argument `out` (see one_writer) while it runs; there is none if `out` is None."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def locked(*args: P.args, **kwargs: P.kwargs) -> R:
            out = signature.bind(*args, **kwargs).arguments.get("out")
            with contextlib.nullcontext() if out is None else one_writer(out, doing):
                return function(*args, **kwargs)

        return locked

    return decorate


def _acquire(file: Path, path: Path, patience: float) -> int:
    """The descriptor of the lock file, locked. Raises SnergError when another has the lock, OSError when the file cannot be opened."""
    end = time.monotonic() + patience
    while True:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(file, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0), 0o644)
        except FileNotFoundError:  # another process has just removed the empty parent
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
    """Lock an open file without waiting; False when another has the lock. Always True on a file system without locks."""
    try:
        if os.name == "nt":
            import msvcrt

            os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
            os.lseek(descriptor, 0, os.SEEK_SET)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in HELD
    return True


def _is_at(descriptor: int, file: Path) -> bool:
    """Whether an open file is still the one at `file`: the previous writer may have deleted it after it was opened here."""
    try:
        there = file.stat()
    except FileNotFoundError:
        return False
    return os.path.samestat(os.fstat(descriptor), there)


def _release(descriptor: int, file: Path) -> None:
    """Delete the lock file, then close it; on Windows, which cannot delete open files, the other way round."""
    if os.name != "nt":
        with contextlib.suppress(OSError):
            file.unlink()
    os.close(descriptor)
    if os.name == "nt":
        with contextlib.suppress(OSError):
            file.unlink()


def remove_locks() -> None:
    """Delete the lock files of this process, which is about to end without finishing its work."""
    for file in list(_held.values()):
        with contextlib.suppress(OSError):
            file.unlink()


def _remove_empty(folders: list[Path]) -> None:
    """Remove parent folders that were created for the lock and are empty."""
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
    """The holder of a lock, as part of an error message."""
    about = _read(file) or {}
    try:
        since = time.strftime("%H:%M", time.localtime(float(about["since"])))
        doing, pid, host = str(about["doing"])[:40], int(about["pid"]), str(about["host"])[:80]
    except (KeyError, TypeError, ValueError, OverflowError, OSError):
        return "another process"
    return f"{doing} that was started at {since} (process {pid} on {host})"
