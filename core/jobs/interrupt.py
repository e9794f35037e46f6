"""Stopping long work within a second, whatever it is doing: for Ctrl-C, and for the end of a job's input.

Asked to stop, work ends by itself at its next call of progress. Where it does not get there in time (JAX compiles a step, an
encoder is slow) a thread beside it ends the process: files are whole or absent at any moment (core/io/files.py), so that this is as
safe as a kill, and what is half-written is deleted first.
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

GRACE = 0.5  # seconds that work has to end by itself
PATIENCE = 60.0  # seconds that it may take longer to save
TICK = 0.05  # seconds between two looks
END = 0  # no signal has this number


def watched(progress: Progress, asked: threading.Event) -> Progress:
    """Progress that raises Cancelled once `asked` is set."""

    def tell(fraction: float, message: str, /) -> None:
        if asked.is_set():
            raise Cancelled("Stopped as you asked; what was finished before is kept.")
        progress(fraction, message)

    return tell


@contextmanager
def deadline(asked: threading.Event, leave: Callable[[], NoReturn], waiting: Callable[[], None]) -> Iterator[None]:
    """Around work that may be asked to stop: where it goes on GRACE seconds after `asked` was set and saves nothing, `leave` is called.

    leave: ends the process, see `leave`; called in another thread, as is waiting, when something is being saved then, which may
    take PATIENCE seconds.
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
    """The first Ctrl-C sets `asked`, the next ones call `again`, in another thread and at once: this one, which must be the main
    thread, may be in the middle of a long call outside Python."""
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


def leave(code: int, last_words: Callable[[], None]) -> NoReturn:
    """Delete what is half-written, say the last words, and end the process, whatever its threads do."""
    remove_unfinished()
    remove_locks()
    last_words()
    end(code)


def end(code: int) -> NoReturn:
    """End the process without waiting for threads or for libraries that tidy up, which may take seconds."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError, RuntimeError):
            stream.flush()
    os._exit(code)
