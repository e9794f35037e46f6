"""Reads a folder that another process may replace at any time, so that all of what is read is of one generation."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from ..errors import Cancelled, SnergError

T = TypeVar("T")
MAX_READS = 20  # after which a folder that is replaced during each read is given up


def one_generation(folder: Path, read: Callable[[], T]) -> T:
    """The result of `read`, which reads a folder (or file) that another process may replace meanwhile.

    `read` is called again if the folder was replaced during the call, so that its result never mixes two generations of the folder.
    Raises what `read` raises, and SnergError when the folder is replaced during each of MAX_READS reads.
    """
    for _ in range(MAX_READS):
        with _held(folder) as same:
            try:
                result = read()
            except Exception as error:
                if isinstance(error, Cancelled) or same():
                    raise
                continue  # files were missing because the folder was replaced
            if same():
                return result
    raise SnergError(f"{folder} is replaced again and again while it is read; wait for what writes it, or stop that.")


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[Callable[[], bool]]:
    """A function that tells whether `folder` is still the same one. It is held open where possible, so that its inode is not reused."""
    before = _status(folder)
    descriptor = None
    if os.name == "posix" and before is not None:
        with contextlib.suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY | os.O_NONBLOCK)  # opening a pipe must not block
            before = os.fstat(descriptor)
    try:
        yield lambda: _same(before, _status(folder))
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _status(path: Path) -> os.stat_result | None:
    try:
        return os.stat(path)
    except (OSError, ValueError):
        return None


def _same(before: os.stat_result | None, now: os.stat_result | None) -> bool:
    return before is now if before is None or now is None else os.path.samestat(before, now)
