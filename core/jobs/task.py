"""Long work that somebody watches and can stop. One interface, and one implementation of its states, for the panel and the terminal.

    waiting ──► running ──► done | failed | cancelled
       └───► cancelling ◄───┘  └──────► (the same three)

A kind of work only says how it advances (`_advance`) and how it is asked to stop (`_stop`): `StepTask` runs a generator, `ThreadTask`
a function in a thread, `runner.Job` a command in a process of its own.
"""

from __future__ import annotations

import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any, Literal

from ..errors import Cancelled, SnergError
from ..progress import Note, Progress, ProgressEvent
from .interrupt import STOPPED, watched

EndState = Literal["done", "failed", "cancelled"]
State = Literal["waiting", "running", "cancelling"] | EndState
POLL_SECONDS = 0.1  # between two polls of a task that is waited for

OUT_OF_MEMORY = "There was not enough memory; lower the resolution or close other programs, then run it again."


@dataclass(frozen=True)
class Outcome:
    """How a task ended. result: what the work returned, JSON values. error: one sentence where it did not end well."""

    state: EndState
    result: dict[str, Any] = field(default_factory=dict)
    error: str = ""

    @classmethod
    def of_error(cls, error: BaseException) -> Outcome:
        """The outcome of work that raised `error`."""
        if isinstance(error, Cancelled):
            return cls("cancelled", error=str(error))
        if isinstance(error, SnergError):
            return cls("failed", error=str(error))
        if isinstance(error, MemoryError):
            return cls("failed", error=OUT_OF_MEMORY)
        sentence = f"An unexpected error occurred ({type(error).__name__}: {error}); please report it with the console's text."
        return cls("failed", error=sentence)


def outcome_of(work: Callable[[], dict[str, Any]]) -> Outcome:
    """Run `work()`. An error that nobody expected prints its traceback and becomes a sentence, so that no watcher waits for ever."""
    try:
        return Outcome("done", work())
    except Exception as error:
        if not isinstance(error, SnergError):
            traceback.print_exc()
        return Outcome.of_error(error)


class Task(ABC):
    """Long work that is under way. Call `poll` repeatedly, then read the rest; nothing blocks but `wait`.

    state: see the top of this file. fraction: done, in [0, 1]. text: what it is doing, a few words. notes: its sticky texts, the
    oldest first. result: what the work returned, once it is done. error: one sentence, once it has failed or was cancelled.
    """

    def __init__(self, text: str = "Starting") -> None:
        self.state: State = "waiting"
        self.fraction = 0.0
        self.text = text
        self.notes: list[str] = []
        self.result: dict[str, Any] = {}
        self.error = ""

    @property
    def ended(self) -> bool:
        """Whether it is done, failed or cancelled."""
        return self.state in ("done", "failed", "cancelled")

    @property
    def cancelling(self) -> bool:
        """Whether it was asked to stop and has not ended yet."""
        return self.state == "cancelling"

    def poll(self) -> bool:
        """Take in what happened since the last call. Returns True until the task has ended."""
        if not self.ended:
            self._advance()
        return not self.ended

    def cancel(self) -> None:
        """Ask the task to stop; it ends at a later poll. Raises SnergError where that is not possible."""
        if self.state in ("waiting", "running"):
            self._stop()
            self.state, self.text = "cancelling", "Stopping"

    def wait(self, progress: Progress | None = None, interval: float = POLL_SECONDS) -> dict[str, Any]:
        """Block until the task ends, polling it every `interval` seconds, and return its result.

        progress: called with each change, with notes as `Note`. Raises SnergError with the task's sentence, or Cancelled. When
        `progress` raises, the task is cancelled first.
        """
        shown = (0, self.fraction, "")
        try:
            while self.poll():
                shown = self._show_changes(progress, *shown) if progress else shown
                self._pause(interval)
        except BaseException:
            self.cancel()
            while self.poll():
                self._pause(interval)
            raise
        if self.state == "cancelled":
            raise Cancelled(self.error)
        if self.state == "failed":
            raise SnergError(self.error)
        return self.result

    def _show_changes(self, progress: Progress, notes: int, fraction: float, text: str) -> tuple[int, float, str]:
        """Report what differs from the number of notes, the fraction and the text reported last. Returns the new three."""
        for note in self.notes[notes:]:
            progress(self.fraction, Note(note))
        if (self.fraction, self.text) != (fraction, text):
            progress(self.fraction, self.text)
        return len(self.notes), self.fraction, self.text

    @abstractmethod
    def _advance(self) -> None:
        """Call `_report` with each event since the last call, and `_finish` once the work has ended."""

    @abstractmethod
    def _stop(self) -> None:
        """Ask the work to stop, once. Raises SnergError."""

    def _pause(self, seconds: float) -> None:
        """Sleep between two polls."""
        time.sleep(seconds)

    def _report(self, event: ProgressEvent, state: Literal["waiting", "running"] = "running") -> None:
        """Take in how far the work is. A task that was asked to stop keeps saying so."""
        self.fraction = event.fraction
        if event.sticky:
            self.notes.append(event.text)
        elif self.state != "cancelling":
            self.state, self.text = state, event.text

    def _finish(self, outcome: Outcome) -> None:
        """Take in how the work ended."""
        self.state, self.result, self.error = outcome.state, outcome.result, outcome.error
        if outcome.state == "done":
            self.fraction = 1.0


class StepTask(Task):
    """Work in this thread, as a generator that yields (fraction, text) and returns the result: each poll runs it to its next yield."""

    def __init__(self, steps: Generator[tuple[float, str], None, dict[str, Any]]) -> None:
        super().__init__()
        self._steps = steps

    def _advance(self) -> None:
        if self.state == "cancelling":
            self._steps.close()  # runs the generator's own clean-up
            self._finish(Outcome("cancelled", error=STOPPED))
            return
        try:
            self._report(ProgressEvent.of(*next(self._steps)))
        except StopIteration as end:
            self._finish(Outcome("done", end.value or {}))
        except SnergError as error:
            self._finish(Outcome.of_error(error))

    def _stop(self) -> None:
        pass  # the next poll closes the generator

    def _pause(self, seconds: float) -> None:
        pass  # a poll is the work itself


class ThreadTask(Task):
    """Work in a thread of this process. work: called there with a `Progress`, which raises Cancelled once the task was asked to stop."""

    def __init__(self, work: Callable[[Progress], dict[str, Any]], text: str = "Starting") -> None:
        super().__init__(text)
        self.state = "running"
        self.news = threading.Event()  # set by the thread where a poll would find something new
        self._stopping = threading.Event()
        self._events: deque[ProgressEvent] = deque()
        self._outcome: Outcome | None = None
        self._thread = threading.Thread(target=self._run, args=(work,), daemon=True, name="snerg-task")
        self._thread.start()

    def _run(self, work: Callable[[Progress], dict[str, Any]]) -> None:
        self._outcome = outcome_of(lambda: work(watched(self._put, self._stopping)))
        self.news.set()

    def _put(self, fraction: float, text: str) -> None:
        self._events.append(ProgressEvent.of(fraction, text))
        self.news.set()

    def _advance(self) -> None:
        outcome = self._outcome  # read first: the last events are there by then
        self.news.clear()
        while self._events:
            self._report(self._events.popleft())
        if outcome is not None:
            self._thread.join()
            self._finish(outcome)

    def _stop(self) -> None:
        self._stopping.set()

    def _pause(self, seconds: float) -> None:
        self.news.wait(seconds)
