"""What a job says and hears.

A job is a verb of the command line running in a process of its own. It speaks JSON, one object a line, on
its standard output:

    {"progress": 0.25, "message": "Training: 28.1 dB"}     any number of these, then one of
    {"result": {...}}                                      what the verb returns
    {"error": "one sentence"}                              exit 2
    {"cancelled": "one sentence"}                          exit 3

and it hears one thing: the end of its standard input, which means stop. The parent closes that pipe to cancel;
when the parent dies the system closes it, so that no job outlives Blender.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any, Protocol, TextIO

from ..errors import Cancelled, SnergError

EXIT_ERROR = 2
EXIT_CANCELLED = 3


class Progress(Protocol):
    """What long work calls as it goes: fraction in 0..1 and a few words. May raise Cancelled."""

    def __call__(self, fraction: float, message: str, /) -> None: ...


class JobReporter:
    """The job's side of the pipe. Call it with (fraction, message): it tells the parent, or raises Cancelled.

    stream: where the lines go. cancelled: set when the parent wants the job to stop.
    """

    def __init__(self, stream: TextIO, cancelled: threading.Event) -> None:
        self._stream = stream
        self._cancelled = cancelled
        self._lock = threading.Lock()

    def __call__(self, fraction: float, message: str, /) -> None:
        """Report progress. Raises Cancelled once the parent has asked the job to stop."""
        if self._cancelled.is_set():
            raise Cancelled("Stopped as you asked; what was finished before is kept.")
        self._say({"progress": min(max(float(fraction), 0.0), 1.0), "message": str(message)})

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
            except (OSError, ValueError):  # nobody listens any more: the same as being told to stop
                self._cancelled.set()


def job_reporter() -> JobReporter:
    """Take over this process's standard output and input for the protocol; call once, early, in a job.

    Whatever else prints (a library's banner, a C extension) goes to standard error from here on, so that it
    cannot break a line of the protocol.
    """
    sys.stdout.flush()
    stream = os.fdopen(os.dup(1), "w", encoding="ascii", newline="\n")
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    cancelled = threading.Event()
    threading.Thread(target=_wait_for_end_of_input, args=(cancelled,), daemon=True, name="snerg-cancel").start()
    return JobReporter(stream, cancelled)


def _wait_for_end_of_input(cancelled: threading.Event) -> None:
    try:
        while os.read(0, 4096):  # the descriptor itself: a lock of sys.stdin would outlive the interpreter
            pass
    except OSError:
        pass
    cancelled.set()


def run_job(work: Callable[[Progress], dict[str, Any]]) -> int:
    """Run `work(progress)` as a job from beginning to end; returns the exit code (0, 2 or 3).

    An error that nobody foresaw still ends in one sentence, with its traceback on standard error.
    """
    reporter = job_reporter()
    try:
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
