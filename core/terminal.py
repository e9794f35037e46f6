"""Progress and results on a terminal, and Ctrl-C."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NoReturn, TextIO

from .errors import EXIT_STOPPED, SnergError, clean, printable
from .jobs import interrupt
from .progress import Progress, ProgressEvent

LINE_SECONDS = 5.0  # between lines of progress where a line cannot be overwritten, such as in a log file
OVERWRITE_SECONDS = 0.1  # between updates of a line that is overwritten
ERASE_LINE = "\r\x1b[K"  # ANSI: to the start of the line, erase to its end
LONGEST_LINE = 100  # characters of a line that is overwritten: a wrapped line could not be erased


class Terminal:
    """Progress for people: one line that is overwritten on a terminal, else a line every LINE_SECONDS. Sticky texts stay."""

    def __init__(self, stream: TextIO) -> None:
        """stream: that progress is written to, such as standard error."""
        self.stream = stream
        self.overwrites = stream.isatty()
        self.last_shown = -math.inf if self.overwrites else time.monotonic()
        self.message = ""

    def __call__(self, fraction: float, message: str, /) -> None:
        """Show the progress of the work, unless the last line is too recent."""
        event = ProgressEvent.of(fraction, message)
        if event.sticky:
            self.write(f"{ERASE_LINE if self.overwrites else ''}{clean(event.text)}\n")
            return
        now = time.monotonic()
        if now - self.last_shown < (OVERWRITE_SECONDS if self.overwrites else LINE_SECONDS):
            return
        self.last_shown = now
        line = f"{100 * fraction:3.0f}%  {clean(message)}"
        self.write(f"{ERASE_LINE}{line[:LONGEST_LINE]}" if self.overwrites else f"{line}\n")
        self.message = message

    def end(self) -> None:
        """Erase the line of progress."""
        if self.overwrites and self.message:
            self.write(ERASE_LINE)
            self.message = ""

    def last(self, sentence: str) -> None:
        """Erase the line of progress and write a sentence."""
        self.end()
        self.write(f"{sentence}\n")

    def write(self, text: str) -> None:
        """Write text. Errors of the stream are ignored: the work goes on when nobody sees its progress."""
        with suppress(OSError, ValueError):
            self.stream.write(text)
            self.stream.flush()


def run_stoppable(work: Callable[[Progress], dict[str, Any]], terminal: Terminal) -> dict[str, Any]:
    """The result of `work(progress)`. Ctrl-C stops it within a second (see interrupt.deadline); the second Ctrl-C ends the process
    at once, without saving. In another thread than the main one, Ctrl-C is not handled. Raises Cancelled when the work stops.
    """
    if threading.current_thread() is not threading.main_thread():
        return work(terminal)
    asked = threading.Event()

    def leave() -> NoReturn:
        interrupt.leave(EXIT_STOPPED, lambda: terminal.last("snerg: Stopped."))

    def waiting() -> None:
        terminal.last("snerg: Saving what is finished; press Ctrl-C again to leave without it.")

    with interrupt.keyboard(asked, leave), interrupt.deadline(asked, leave, waiting):
        return work(interrupt.watched(terminal, asked))


def write_result(text: str) -> None:
    """Write a result of one or more lines to standard output. Raises SnergError when its reader is gone or its disk is full."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    text = "\n".join(printable(line) for line in text.split("\n"))
    try:
        print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except OSError as error:
        with suppress(OSError, ValueError, AttributeError):  # else the buffered text would fail again when the interpreter ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SnergError(f"The result cannot be written to standard output ({error.strerror}); what was asked for is done.") from error
