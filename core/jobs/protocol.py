"""What a job writes while it runs, and how it is asked to stop: the job's own side (runner.py is the other).

A job is a command of the command line that runs in a process of its own. It writes JSON, one object a line, to its standard output,
which is the file `events.jsonl` of the job's folder (folder.py):

    {"progress": 0.25, "message": "Training: 28.1 dB"}     any number of these (progress.ProgressEvent); with "note": true the message
                                                           stays on the screen, with "waiting": true the job waits for its turn
    {"result": {...}}                                      what the command returns; exit 0
    {"error": "one sentence"}                              exit 2
    {"cancelled": "one sentence"}                          exit 3

One of the last three is the last line. The job stops when the file `stop` appears in its folder, or when the folder is deleted. An
attached job, whose starter waits for it, also stops at the end of its standard input, a pipe that the system closes when the starter
ends; any other job outlives the process that started it.
"""

from __future__ import annotations

import functools
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from ..errors import EXIT_ERROR, Cancelled, SnergError
from ..progress import Progress, ProgressEvent
from . import folder as folders
from .interrupt import PATIENCE, STOPPED, deadline, leave
from .task import Outcome, outcome_of

EXIT_CANCELLED = 3
EXIT_CODES = {"done": 0, "failed": EXIT_ERROR, "cancelled": EXIT_CANCELLED}
GRACE_SECONDS = PATIENCE + 15.0  # from the request to stop until a job is ended that its `deadline` did not end
UNSAVED = "Stopped; what it had not yet saved is lost."
LISTEN_SECONDS = 0.1  # between two checks for a request to stop
TURN_SECONDS = 0.2  # between two checks whether it is the job's turn
LOCK_SECONDS = 5.0  # to get the job's own lock, which others hold for a moment to see whether the job runs


class JobReporter:
    """The `Progress` of a job, which writes each report as a line. Calls raise Cancelled once the job was asked to stop.

    stream: where the lines go. stopping: set when the job should stop. last_words: the error of the outcome when the job has to be
    ended because it did not stop by itself.
    """

    def __init__(self, stream: TextIO, stopping: threading.Event) -> None:
        self.stopping = stopping
        self.last_words = UNSAVED
        self._stream = stream
        self._lock = threading.Lock()

    def __call__(self, fraction: float, text: str, /) -> None:
        """Report progress. Raises Cancelled once the job was asked to stop."""
        self.check()
        self._write(ProgressEvent.of(fraction, text).to_json())

    def waiting(self, text: str) -> None:
        """Report that the job waits for its turn, and for what. Raises Cancelled once the job was asked to stop."""
        self.check()
        self._write({**ProgressEvent(0.0, text).to_json(), "waiting": True})

    def check(self) -> None:
        """Raise Cancelled once the job was asked to stop."""
        if self.stopping.is_set():
            raise Cancelled(STOPPED)

    def end(self, outcome: Outcome) -> int:
        """Write the last line, which says how the job ended, and return the exit code for it."""
        if outcome.state == "done":
            self._write({"result": outcome.result})
        else:
            self._write({"error" if outcome.state == "failed" else "cancelled": outcome.error})
        return EXIT_CODES[outcome.state]

    def cancelled(self, sentence: str) -> int:
        """`end` of a job that was asked to stop."""
        return self.end(Outcome("cancelled", error=sentence))

    def _write(self, line: dict[str, Any]) -> None:
        with self._lock:
            try:
                self._stream.write(json.dumps(line) + "\n")
                self._stream.flush()
            except (OSError, ValueError):  # the reader is gone, or the disk is full: the same as a request to stop
                self.stopping.set()


@functools.cache
def own_folder() -> Path | None:
    """The folder of the job that this process runs; None where it runs none. Child processes do not inherit it."""
    value = os.environ.pop(folders.VARIABLE, None)
    return Path(value) if value else None


@functools.cache
def job_reporter() -> JobReporter:
    """Take over this process's standard output for the protocol, and watch for a request to stop from now on; call early.

    Everything else that prints (a library's banner, a C extension) goes to standard error, so that it cannot break a line.
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
    """Wait until no older job of the project runs. Returns 0 when it is this job's turn, EXIT_CANCELLED when it was asked to stop.

    Call it before large modules are imported, so that a waiting job needs little memory.
    """
    reporter, folder, reported = job_reporter(), own_folder(), ""
    if folder is None:
        return 0
    try:
        while True:
            before = (other for other in folders.job_folders(folder.parents[1]) if other.name < folder.name)
            older = next(filter(folders.is_alive, before), None)
            if older is None and folders.hold(folder.parent / folders.TURN) is not None:  # held until this process ends
                return 0
            message = f"Waits for {folders.label_of(older) if older else 'another job'}"
            if message != reported:
                reported = message
                reporter.waiting(message)
            reporter.check()
            time.sleep(TURN_SECONDS)
    except (Cancelled, KeyboardInterrupt):
        return reporter.cancelled("Stopped as you asked, before it began.")


def _hold_own_lock(folder: Path) -> None:
    end = time.monotonic() + LOCK_SECONDS
    while (descriptor := folders.hold(folder / folders.LOCK)) is None:
        if time.monotonic() > end:
            raise SnergError(f"{folder} is the folder of another job that runs; start the job again.")
        time.sleep(0.02)
    os.write(descriptor, f"{os.getpid()}\n".encode())  # stays open: the system closes it when the process ends


def _in_background(listen: Callable[..., None], *arguments: Any) -> None:
    threading.Thread(target=listen, args=arguments, daemon=True, name="snerg-listen").start()


def _listen(folder: Path, reporter: JobReporter) -> None:
    """Wait until the job is asked to stop, or its folder is deleted. End it after GRACE_SECONDS if it did not stop by itself."""
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
    """Called when the result is being saved: the request to stop waits for it, and there is nobody to tell."""


def run_job(work: Callable[[Progress], dict[str, Any]]) -> int:
    """Wait for the job's turn, run `work(progress)`, and write how it ended. Returns the exit code: 0, 2 (failed) or 3 (cancelled).

    An unexpected error ends the job with one sentence too; its traceback goes to standard error.
    """
    reporter = job_reporter()
    if code := await_turn():
        return code
    try:
        with deadline(reporter.stopping, lambda: leave(EXIT_CANCELLED, lambda: reporter.cancelled(reporter.last_words)), _keep_waiting):
            outcome = outcome_of(lambda: work(reporter))
    except KeyboardInterrupt:
        outcome = Outcome("cancelled", error="Stopped from the keyboard.")
    return reporter.end(outcome)
