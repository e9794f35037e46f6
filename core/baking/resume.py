"""Runs long work in parts on a few threads, and keeps finished parts in a folder so that a killed bake can go on."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeout
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.files import MARK, check_replaceable, discard, write_arrays, write_bytes
from ..io.guard import read_arrays, reading

Arrays = dict[str, NDArray[Any]]
THREADS = min(os.cpu_count() or 1, 4)  # parts worked on at once: NumPy runs in one while XLA, which has threads of its own, runs in another
MAX_BYTES = 2**33  # of a file that is read
SAVE_SECONDS = 5.0  # seconds between two writes: the work that a kill can cost
POLL_SECONDS = 0.2  # seconds between two calls of `tell` while a part is being waited for


class ResumeCache:
    """Finished parts of some work, by stage and number, in a folder; with folder None nothing is kept.

    key: names the work, and is part of each file's name; files of other work in the same folder are removed. Files are written whole or
    not at all. Raises SnergError when the folder holds files that are not a bake's.
    """

    def __init__(self, folder: Path | None, key: str) -> None:
        self.folder, self.key = folder, key
        self.unsaved: Arrays = {}
        self.stage, self.saved_at = "", time.monotonic()
        if folder is not None and folder.is_dir():
            check_replaceable(folder)
            for path in folder.iterdir():
                if path.is_dir():  # a half-written file of a killed process
                    discard(path)
                elif path.name != MARK and not path.name.startswith(key):
                    path.unlink(missing_ok=True)

    def read(self, stage: str) -> Iterator[tuple[int, Arrays]]:
        """(number, arrays) of each kept part of a stage; damaged files are skipped."""
        if self.folder is None:
            return
        for path in sorted(self.folder.glob(f"{self.key}-{stage}-*.npz")):
            parts: dict[int, Arrays] = {}
            try:
                with reading(path, "delete it"):
                    for name, array in read_arrays(path, MAX_BYTES).items():
                        part, _, short = name.partition(".")
                        parts.setdefault(int(part), {})[short] = array
            except SnergError:
                continue
            yield from parts.items()

    def add(self, stage: str, part: int, arrays: Arrays) -> None:
        """Keep a part. It is written within SAVE_SECONDS, or when `flush` is called."""
        if self.folder is None:
            return
        self.stage = stage
        self.unsaved |= {f"{part}.{name}": array for name, array in arrays.items()}
        if self.due:
            self.flush()

    @property
    def due(self) -> bool:
        """Whether the last write is SAVE_SECONDS ago."""
        return self.folder is not None and time.monotonic() - self.saved_at > SAVE_SECONDS

    def flush(self) -> None:
        """Write all parts that are not on the disk yet. Raises SnergError when that fails."""
        if self.folder is not None and self.unsaved:
            first = int(next(iter(self.unsaved)).partition(".")[0])
            if not (self.folder / MARK).exists():
                write_bytes(self.folder / MARK, b"A bake that is under way; it goes on here when it is started again.\n")
            write_arrays(self.folder / f"{self.key}-{self.stage}-{first:06d}.npz", self.unsaved)
        self.unsaved, self.saved_at = {}, time.monotonic()


def arrays_match(arrays: Arrays, expected: Mapping[str, tuple[tuple[int, ...], type]]) -> bool:
    """Whether arrays have exactly the names, shapes and kinds of element of `expected`: {name: (shape, NumPy type or its parent)}."""
    return arrays.keys() == expected.keys() and all(
        arrays[name].shape == shape and np.issubdtype(arrays[name].dtype, kind) for name, (shape, kind) in expected.items()
    )


def run_parts(
    stage: str,
    count: int,
    work: Callable[[int], Arrays],
    cache: ResumeCache,
    tell: Callable[[float], None],
    is_valid: Callable[[int, Arrays], bool] = lambda part, arrays: True,
) -> Iterator[tuple[int, Arrays]]:
    """Yield (number, work(number)) for the parts 0 to count - 1 of a stage: kept ones first, then the others as a few threads finish them.

    is_valid: whether kept arrays can be those of the part; if not, it is computed again. tell: called with the finished fraction several
    times a second; an exception of it stops the work and is raised, and finished parts stay kept.
    """
    done = set()
    for part, arrays in cache.read(stage):
        if 0 <= part < count and part not in done and is_valid(part, arrays):
            done.add(part)
            yield part, arrays
    pool = ThreadPoolExecutor(THREADS)
    pending: deque[tuple[int, Future[Arrays]]] = deque()
    todo = iter([part for part in range(count) if part not in done])
    try:
        while True:
            while len(pending) < 2 * THREADS and (part := next(todo, -1)) >= 0:
                pending.append((part, pool.submit(work, part)))
            if not pending:
                break
            part, future = pending.popleft()
            arrays = _wait(future, lambda: tell(len(done) / count))
            done.add(part)
            cache.add(stage, part, arrays)
            yield part, arrays
            tell(len(done) / count)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        cache.flush()


def _wait(future: Future[Arrays], poll: Callable[[], None]) -> Arrays:
    """The future's result; calls `poll` every POLL_SECONDS until then."""
    while True:
        try:
            return future.result(POLL_SECONDS)
        except FutureTimeout:
            if future.done():
                raise  # a TimeoutError of the work itself
            poll()
