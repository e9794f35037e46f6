"""The one piece of long work that Blender's window is busy with, for the panels to show and to stop."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from ..core.errors import Cancelled, SnergError
from ..core.jobs.runner import State, outcome


class Work(Protocol):
    """What a job (core/jobs/runner.py) and work inside Blender (`Steps`) have in common."""

    state: State
    fraction: float
    message: str
    result: dict[str, Any]
    error: str

    @property
    def cancelling(self) -> bool: ...
    def poll(self) -> bool: ...
    def cancel(self) -> None: ...
    def wait(self, progress: Callable[[float, str], None] | None = None) -> dict[str, Any]: ...


class Steps:
    """Work that only Blender itself can do, as a generator of (fraction, message); each poll does one step of it."""

    def __init__(self, steps: Iterator[tuple[float, str]]) -> None:
        self.state: State = "running"
        self.fraction = 0.0
        self.message = "Starting"
        self.result: dict[str, Any] = {}
        self.error = ""
        self._steps: Any = steps
        self._cancelled = False

    @property
    def cancelling(self) -> bool:
        """Told to stop, and the step under way not yet done."""
        return self.state == "running" and self._cancelled

    def poll(self) -> bool:
        """Do the next step; True while there are more."""
        if self.state != "running":
            return False
        try:
            if self._cancelled:
                self._steps.close()  # runs the generator's own cleaning up
                raise Cancelled("Stopped as you asked; nothing was written.")
            self.fraction, self.message = next(self._steps)
        except StopIteration as end:
            self.state, self.fraction, self.result = "done", 1.0, end.value or {}
        except Cancelled as stop:
            self.state, self.error = "cancelled", str(stop)
        except SnergError as error:
            self.state, self.error = "failed", str(error)
        return self.state == "running"

    def cancel(self) -> None:
        """Stop before the next step."""
        self._cancelled = True

    def wait(self, progress: Callable[[float, str], None] | None = None) -> dict[str, Any]:
        """Do all steps and return the result. Raises as Job.wait does."""
        try:
            while self.poll():
                if progress:
                    progress(self.fraction, self.message)
        except BaseException:
            self._steps.close()
            raise
        return outcome(self.state, self.result, self.error)


@dataclass
class Activity:
    """step: which panel shows it ('dataset', 'field', ...). label: what it is called ('Training')."""

    step: str
    label: str
    work: Work


_current: Activity | None = None


def current() -> Activity | None:
    """What is under way, None when nothing is."""
    return _current


def begin(activity: Activity) -> None:
    """Make it the one under way. Raises SnergError when something else is."""
    global _current
    if _current is not None:
        raise SnergError(f"{_current.label} is still under way; wait for it or stop it first.")
    _current = activity


def end() -> None:
    """Nothing is under way any more."""
    global _current
    _current = None


def stop() -> None:
    """Tell what is under way to stop, and forget it."""
    if _current is not None:
        _current.work.cancel()
    end()
