"""Stopping long work within a second, whatever it is doing: on Ctrl-C, or when a job is asked to stop.

Work that was asked to stop raises Cancelled at its next call of `progress`. Where that call does not come in time (JAX compiles a step,
an encoder is slow), another thread ends the process. That is as safe as a kill, because files are always complete or absent
(core/io/files.py); unfinished temporary files are deleted first.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn

from ..errors import Cancelled
from ..io.files import SAVING, remove_unfinished
from ..io.lock import remove_locks
from ..progress import Progress

GRACE = 0.5  # seconds from the request to stop in which work may end by itself
PATIENCE = 60.0  # seconds that a save under way may take longer than that
TICK = 0.05  # seconds between two checks
END = 0  # ends the thread that listens; no signal has this number
STOPPED = "Stopped as you asked; what was finished before is kept."


def watched(progress: Progress, asked: threading.Event) -> Progress:
    """`progress`, but calls raise Cancelled once `asked` is set."""

    def report(fraction: float, text: str, /) -> None:
        if asked.is_set():
            raise Cancelled(STOPPED)
        progress(fraction, text)

    return report


@contextmanager
def deadline(asked: threading.Event, leave: Callable[[], NoReturn], waiting: Callable[[], None]) -> Iterator[None]:
    """Around work that may be asked to stop: call `leave` where the work still runs GRACE seconds after `asked` was set.

    leave: ends the process, as the function `leave` does. waiting: called in place of it while something is being saved; `leave` then
    follows after the save, or after PATIENCE seconds. Both are called in another thread.
    """
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(TICK) and not asked.is_set():
            pass
        if ended.wait(GRACE):
            return
        free = SAVING.acquire(timeout=0)
        if not free:
            waiting()
            free = SAVING.acquire(timeout=PATIENCE)
        try:  # from here on nothing more is saved
            if not ended.wait(TICK):
                leave()
        finally:
            if free:
                SAVING.release()

    watcher = threading.Thread(target=watch, daemon=True, name="snerg-deadline")
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()


@contextmanager
def keyboard(asked: threading.Event, again: Callable[[], None]) -> Iterator[None]:
    """The first Ctrl-C sets `asked`, each further one calls `again`, at once and in another thread.

    The thread that enters must be the main thread. It cannot react itself during a long call outside Python.
    """
    ours, signals = socket.socketpair()
    signals.setblocking(False)

    def listen() -> None:
        while (number := ours.recv(1)[0]) != END:
            if number == signal.SIGINT and asked.is_set():
                again()
            elif number == signal.SIGINT:
                asked.set()

    listener = threading.Thread(target=listen, daemon=True, name="snerg-keyboard")
    listener.start()
    before = signal.signal(signal.SIGINT, lambda number, frame: None)
    descriptor = signal.set_wakeup_fd(signals.fileno(), warn_on_full_buffer=False)
    try:
        yield
    finally:  # None: a handler that was installed in C, as Blender's is, cannot be put back from here
        signal.set_wakeup_fd(descriptor)
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
        signals.setblocking(True)
        signals.send(bytes([END]))
        listener.join()
        signals.close()
        ours.close()


def leave(code: int, last_words: Callable[[], object]) -> NoReturn:
    """Delete unfinished files, call `last_words`, and end the process with exit code `code`, whatever its threads do."""
    remove_unfinished()
    remove_locks()
    last_words()
    end(code)


def end(code: int) -> NoReturn:
    """End the process without waiting for threads or for the clean-up of libraries, which may take seconds."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError, RuntimeError):
            stream.flush()
    os._exit(code)
