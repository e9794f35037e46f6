"""Long work in parts, which a few threads do: what is finished is kept in a folder, so that it outlives a kill."""

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
THREADS = min(os.cpu_count() or 1, 4)  # NumPy in one while XLA runs in another; XLA has threads of its own
MAX_BYTES = 2**33
SAVE_SECONDS = 5.0  # seconds of work that a kill may cost
POLL_SECONDS = 0.2  # seconds between two looks whether to stop


class ResumeCache:
    """Results of parts of work by stage and number, of the work that `key` names; without a folder nothing is kept.

    Every file is whole or not there, and its name says whose it is, so that other work in the same folder is never taken for this.
    """

    def __init__(self, folder: Path | None, key: str) -> None:
        self.folder, self.key = folder, key
        self.new: Arrays = {}
        self.stage, self.saved = "", time.monotonic()
        if folder is not None and folder.is_dir():
            check_replaceable(folder)
            for path in folder.iterdir():
                if path.is_dir():  # what a kill left half-written
                    discard(path)
                elif path.name != MARK and not path.name.startswith(key):
                    path.unlink(missing_ok=True)

    def read(self, stage: str) -> Iterator[tuple[int, Arrays]]:
        """The parts of a stage that were finished before; a damaged file counts as none."""
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
        """Keep a part; it is on the disk a few seconds later, or when the stage ends."""
        if self.folder is None:
            return
        self.stage = stage
        self.new |= {f"{part}.{name}": array for name, array in arrays.items()}
        if self.due:
            self.flush()

    @property
    def due(self) -> bool:
        """Whether it is time to write."""
        return self.folder is not None and time.monotonic() - self.saved > SAVE_SECONDS

    def flush(self) -> None:
        """Write what is not on the disk yet. Raises SnergError when it cannot."""
        if self.folder is not None and self.new:
            first = int(next(iter(self.new)).partition(".")[0])
            if not (self.folder / MARK).exists():
                write_bytes(self.folder / MARK, b"A bake that is under way; it goes on here when it is started again.\n")
            write_arrays(self.folder / f"{self.key}-{self.stage}-{first:06d}.npz", self.new)
        self.new, self.saved = {}, time.monotonic()


def arrays_match(arrays: Arrays, wanted: Mapping[str, tuple[tuple[int, ...], type]]) -> bool:
    """Whether arrays have just these names, shapes and kinds of values, as what is kept of a part must."""
    return arrays.keys() == wanted.keys() and all(
        arrays[name].shape == shape and np.issubdtype(arrays[name].dtype, kind) for name, (shape, kind) in wanted.items()
    )


def run_parts(
    stage: str,
    count: int,
    work: Callable[[int], Arrays],
    kept: ResumeCache,
    tell: Callable[[float], None],
    fits: Callable[[int, Arrays], bool] = lambda part, arrays: True,
) -> Iterator[tuple[int, Arrays]]:
    """(number, `work(number)`) of every part of a stage, those that are kept first, the others from a few threads.

    fits: whether what is kept of a part can be it; it is done again where not.
    tell: called with the fraction done several times a second; what it raises stops the work, and finished parts are kept.
    """
    done = set()
    for part, arrays in kept.read(stage):
        if 0 <= part < count and part not in done and fits(part, arrays):
            done.add(part)
            yield part, arrays
    pool = ThreadPoolExecutor(THREADS)
    ahead: deque[tuple[int, Future[Arrays]]] = deque()
    todo = iter([part for part in range(count) if part not in done])
    try:
        while True:
            while len(ahead) < 2 * THREADS and (part := next(todo, -1)) >= 0:
                ahead.append((part, pool.submit(work, part)))
            if not ahead:
                break
            part, future = ahead.popleft()
            arrays = _wait(future, lambda: tell(len(done) / count))
            done.add(part)
            kept.add(stage, part, arrays)
            yield part, arrays
            tell(len(done) / count)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        kept.flush()


def _wait(future: Future[Arrays], look: Callable[[], None]) -> Arrays:
    while True:
        try:
            return future.result(POLL_SECONDS)
        except FutureTimeout:
            if future.done():
                raise  # the work's own
            look()
