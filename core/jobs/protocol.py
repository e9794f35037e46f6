"""What a job says and hears.

A job is a verb of the command line running in a process of its own. It speaks JSON, one object a line, on its standard output,
which is the file `events.jsonl` of the job's folder (folder.py):

    {"progress": 0.25, "message": "Training: 28.1 dB"}     any number of these, and of
    {"progress": 0.0, "message": "...", "note": true}      messages to keep beside those that follow (progress.Note); then one of
    {"result": {...}}                                      what the verb returns
    {"error": "one sentence"}                              exit 2
    {"cancelled": "one sentence"}                          exit 3

It hears one thing: stop, when the file `stop` appears in its folder, or the folder is gone. A job that somebody waits for
also stops at the end of its standard input, a pipe that the system closes when the one who waits dies; any other job outlives who
started it.
"""

from __future__ import annotations

import functools
import json
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TextIO

from ..errors import EXIT_ERROR, Cancelled, SnergError
from ..progress import Note
from . import folder as folders
from .interrupt import PATIENCE, deadline, leave

EXIT_CANCELLED = 3
GRACE_SECONDS = PATIENCE + 15.0  # after which a job that was told to stop, and is not stopped by its `deadline`, is ended
LISTEN_SECONDS = 0.1  # between looks whether to stop
TURN_SECONDS = 0.2  # between looks whether it is the job's turn
LOCK_SECONDS = 5.0  # in which a job's own lock, which others only ever hold to look at it, must be had


class Progress(Protocol):
    """What long work calls as it goes: fraction in 0..1 and a few words. May raise Cancelled."""

    def __call__(self, fraction: float, message: str, /) -> None: ...


class JobReporter:
    """The job's side. Call it with (fraction, message): it tells whoever watches, or raises Cancelled.

    stream: where the lines go. stopping: set when the job shall stop. last_words: the sentence with which it is
    ended then, if it has not ended by itself.
    """

    def __init__(self, stream: TextIO, stopping: threading.Event) -> None:
        self.stopping = stopping
        self.last_words = "Stopped; what it had not yet saved is lost."
        self._stream = stream
        self._lock = threading.Lock()

    def __call__(self, fraction: float, message: str, /) -> None:
        """Report progress. Raises Cancelled once the job was asked to stop."""
        self.check()
        line = {"progress": min(max(float(fraction), 0.0), 1.0), "message": str(message)}
        self._say({**line, "note": True} if isinstance(message, Note) else line)

    def check(self) -> None:
        """Raise Cancelled once the job was asked to stop."""
        if self.stopping.is_set():
            raise Cancelled("Stopped as you asked; what was finished before is kept.")

    def result(self, value: dict[str, Any]) -> None:
        """The last line of work that ended well."""
        self._say({"result": value})

    def error(self, sentence: str) -> None:
        """The last line of work that failed."""
        self._say({"error": sentence})

    def cancelled(self, sentence: str) -> None:
        """The last line of work that was stopped."""
        self._say({"cancelled": sentence})

    def _say(self, line: dict[str, Any]) -> None:
        with self._lock:
            try:
                self._stream.write(json.dumps(line) + "\n")
                self._stream.flush()
            except (OSError, ValueError):  # nobody listens any more, or the disk is full: the same as being told to stop
                self.stopping.set()


@functools.cache
def own_folder() -> Path | None:
    """The folder of the job that this process is; None where it is none. Processes that it starts are not the job."""
    value = os.environ.pop(folders.VARIABLE, None)
    return Path(value) if value else None


@functools.cache
def job_reporter() -> JobReporter:
    """Take over this process's standard output for the protocol, and listen from here on whether to stop; call early.

    Whatever else prints (a library's banner, a C extension) goes to standard error, so that it cannot break a line.
    """
    sys.stdout.flush()
    stream = os.fdopen(os.dup(1), "w", encoding="ascii", newline="\n")
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    reporter, folder = JobReporter(stream, threading.Event()), own_folder()
    if folder is not None:
        _hold_own_lock(folder)
        _in_background(_listen, folder, reporter)
    if folder is None or folders.read_record(folder).get("attached"):
        _in_background(_wait_for_end_of_input, reporter)
    return reporter


@functools.cache
def await_turn() -> int:
    """Wait until no older job of the project lives. Returns 0 when it is this job's turn, EXIT_CANCELLED when it shall stop.

    Call it before anything heavy is imported: a job that waits is small.
    """
    reporter, folder, said = job_reporter(), own_folder(), ""
    if folder is None:
        return 0
    try:
        while True:
            before = (other for other in folders.job_folders(folder.parents[1]) if other.name < folder.name)
            older = next(filter(folders.is_alive, before), None)
            if older is None and folders.hold(folder.parent / folders.TURN) is not None:  # held until this process ends
                return 0
            message = f"Waits for {folders.label_of(older) if older else 'another job'}"
            if message != said:
                said = message
                reporter(0.0, message)
            reporter.check()
            time.sleep(TURN_SECONDS)
    except (Cancelled, KeyboardInterrupt):
        reporter.cancelled("Stopped as you asked, before it began.")
        return EXIT_CANCELLED


def _hold_own_lock(folder: Path) -> None:
    end = time.monotonic() + LOCK_SECONDS
    while (descriptor := folders.hold(folder / folders.LOCK)) is None:
        if time.monotonic() > end:
            raise SnergError(f"{folder} is the folder of another job that runs; start the job again.")
        time.sleep(0.02)
    os.write(descriptor, f"{os.getpid()}\n".encode())  # never closed: the system does


def _in_background(listen: Callable[..., None], *arguments: Any) -> None:
    threading.Thread(target=listen, args=arguments, daemon=True, name="snerg-listen").start()


def _listen(folder: Path, reporter: JobReporter) -> None:
    """Until the job is asked to stop, or its folder is deleted; then end it, if it does not end itself."""
    while folder.exists() and not (folder / folders.STOP).exists():
        time.sleep(LISTEN_SECONDS)
    reporter.stopping.set()
    time.sleep(GRACE_SECONDS)
    reporter.cancelled(reporter.last_words)
    os._exit(EXIT_CANCELLED)


def _wait_for_end_of_input(reporter: JobReporter) -> None:
    try:
        while os.read(0, 4096):  # the descriptor itself: a lock of sys.stdin would outlive the interpreter
            pass
    except OSError:
        pass
    reporter.stopping.set()


def _keep_waiting() -> None:
    """The result is being saved: whoever asked to stop waits for that."""


def run_job(work: Callable[[Progress], dict[str, Any]]) -> int:
    """Run `work(progress)` as a job from beginning to end, when its turn has come; returns the exit code (0, 2 or 3).

    An error that nobody foresaw still ends in one sentence, with its traceback on standard error.
    """
    reporter = job_reporter()
    if code := await_turn():
        return code
    try:
        with deadline(reporter.stopping, lambda: leave(EXIT_CANCELLED, lambda: reporter.cancelled(reporter.last_words)), _keep_waiting):
            result = work(reporter)
    except Cancelled as stop:
        reporter.cancelled(str(stop))
        return EXIT_CANCELLED
    except SnergError as error:
        reporter.error(str(error))
    except MemoryError:
        traceback.print_exc()
        reporter.error("There was not enough memory; lower the resolution or close other programs, then run it again.")
    except KeyboardInterrupt:
        reporter.cancelled("Stopped from the keyboard.")
        return EXIT_CANCELLED
    except Exception as error:
        traceback.print_exc()
        reporter.error(f"Something went wrong that should not ({type(error).__name__}: {error}); please report it with the console's text.")
    else:
        reporter.result(result)
        return 0
    return EXIT_ERROR
