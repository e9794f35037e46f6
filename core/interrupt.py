"""Stopping long work within a second, whatever it is doing: for Ctrl-C, and for the end of a job's input.

The work runs in a thread of its own. Asked to stop, it ends by itself at its next call of progress. Work that does not get there
in time (JAX compiling a step, an encoder) is left behind and the process ends: files are whole or absent at any moment
(core/files.py), so that this is as safe as a kill, and what is half-written is deleted first.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn, TypeVar

from .errors import Cancelled
from .files import SAVING, remove_unfinished
from .progress import Progress

GRACE = 0.6  # seconds that work has to end by itself
PATIENCE = 60.0  # seconds that it may take longer to save
TICK = 0.05  # seconds between two looks: on Windows, what a signal waits for
STACK = 2**24  # bytes, as a main thread has; macOS gives other threads half a megabyte, too little for JAX
Result = TypeVar("Result")


def watched(progress: Progress, asked: threading.Event) -> Progress:
    """Progress that raises Cancelled once `asked` is set."""

    def tell(fraction: float, message: str, /) -> None:
        if asked.is_set():
            raise Cancelled("Stopped as you asked; what was finished before is kept.")
        progress(fraction, message)

    return tell


def run(work: Callable[[], Result], asked: threading.Event, leave: Callable[[], NoReturn], waiting: Callable[[], None]) -> Result:
    """What `work()` returns or raises, in a thread of its own. Call it in the main thread, which waits in short steps and hears signals.

    leave: called when the work goes on GRACE seconds after `asked` was set and saves nothing; it ends the process, see `leave`.
    waiting: called when something is being saved then, which may take PATIENCE seconds.
    """
    results: list[Result] = []
    errors: list[BaseException] = []
    ended = threading.Event()

    def target() -> None:
        try:
            results.append(work())
        except BaseException as error:
            errors.append(error)
        finally:
            ended.set()

    before = threading.stack_size(STACK)
    try:
        threading.Thread(target=target, daemon=True, name="snerg-work").start()
    finally:
        threading.stack_size(before)
    while not ended.wait(TICK) and not asked.is_set():
        pass
    if not ended.wait(GRACE) and not _saved(ended, waiting):
        leave()
    if errors:
        raise errors[0]
    return results[0]


def _saved(ended: threading.Event, waiting: Callable[[], None]) -> bool:
    """Wait for what is being saved, and let nothing more be saved; whether the work ended with that."""
    free = SAVING.acquire(timeout=0)
    if not free:
        waiting()
        free = SAVING.acquire(timeout=PATIENCE)
    if ended.wait(TICK) and free:
        SAVING.release()
    return ended.is_set()


def leave(code: int, last_words: Callable[[], None]) -> NoReturn:
    """Delete what is half-written, say the last words, and end the process, whatever its threads do."""
    remove_unfinished()
    last_words()
    end(code)


def end(code: int) -> NoReturn:
    """End the process without waiting for threads or for libraries that tidy up, which may take seconds."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError, RuntimeError):
            stream.flush()
    os._exit(code)
