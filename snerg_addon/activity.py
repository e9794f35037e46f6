"""The long work that Blender's window shows and can stop: jobs of the open projects, and what Blender does itself."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import bpy

from ..core.errors import Cancelled, SnergError
from ..core.jobs.runner import Job, State, outcome


class Work(Protocol):
    """What a job (core/jobs/runner.py) and work inside Blender (`Steps`) have in common."""

    state: State
    fraction: float
    message: str
    notes: list[str]
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
        self.notes: list[str] = []
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


class Thought:
    """Work that needs nothing of Blender and yet belongs into its process, in a thread of its own: reading, mostly.

    think: called with progress(fraction, message), which raises Cancelled when it shall stop; what it returns is the result.
    """

    def __init__(self, think: Callable[[Callable[[float, str], None]], dict[str, Any]]) -> None:
        self.state: State = "running"
        self.fraction = 0.0
        self.message = "Starting"
        self.notes: list[str] = []
        self.result: dict[str, Any] = {}
        self.error = ""
        self._ended: tuple[State, Any] | None = None
        self._cancelled = False
        self._thread = threading.Thread(target=self._run, args=(think,), daemon=True, name="snerg-thought")
        self._thread.start()

    def _run(self, think: Callable[[Callable[[float, str], None]], dict[str, Any]]) -> None:
        try:
            self._ended = "done", think(self._told)
        except Cancelled as stop:
            self._ended = "cancelled", str(stop)
        except SnergError as error:
            self._ended = "failed", str(error)
        except Exception as error:  # a bug, but one that must not leave the panel waiting for ever
            traceback.print_exc()
            self._ended = "failed", f"Something went wrong that should not ({type(error).__name__}: {error}); please report it."

    def _told(self, fraction: float, message: str) -> None:
        if self._cancelled:
            raise Cancelled("Stopped as you asked; nothing was changed.")
        self.fraction, self.message = fraction, message

    @property
    def cancelling(self) -> bool:
        """Told to stop, and not yet there."""
        return self.state == "running" and self._cancelled

    def poll(self) -> bool:
        """True while it goes on."""
        if self.state == "running" and not self._thread.is_alive() and self._ended is not None:
            self.state = self._ended[0]
            if self.state == "done":
                self.result, self.fraction = self._ended[1], 1.0
            else:
                self.error = self._ended[1]
        return self.state == "running"

    def cancel(self) -> None:
        """Stop when it next tells how it goes."""
        self._cancelled = True

    def wait(self, progress: Callable[[float, str], None] | None = None) -> dict[str, Any]:
        """Wait for it and return the result. Raises as Job.wait does."""
        while self._thread.is_alive():
            self._thread.join(0.05)
            if progress:
                progress(self.fraction, self.message)
        self.poll()
        return outcome(self.state, self.result, self.error)


@dataclass
class Activity:
    """step: which panel shows it ('dataset', 'field', ...). label: what it is called ('Training').

    operator: its bl_idname. project: the project's folder. scene: the name of the scene that it was started in, which `session`
    (session_uid) names as long as the file is open.
    """

    step: str
    label: str
    work: Work
    operator: str = ""
    project: Path = Path()
    scene: str = ""
    session: int = 0

    @property
    def key(self) -> str:
        """Names it among all."""
        folder = self.work.folder if isinstance(self.work, Job) else None
        return str(folder) if folder else f"{id(self.work):x}"

    @property
    def is_job(self) -> bool:
        """Whether it is a process of its own, or else what Blender does itself."""
        return isinstance(self.work, Job)

    @property
    def outlives(self) -> bool:
        """Whether it goes on when Blender closes: a job, unless Blender deletes its folder, as it does with its temporary one."""
        return self.is_job and Path(bpy.app.tempdir) not in self.project.parents


_activities: list[Activity] = []
_last: dict[Path, tuple[str, bool]] = {}


def current(project: Path | None = None) -> list[Activity]:
    """What is under way, the oldest first: in all open projects, or in the one whose folder is given."""
    return [activity for activity in _activities if project is None or activity.project == project]


def begin(activity: Activity) -> None:
    """Show it from now on."""
    _activities.append(activity)
    _last.pop(activity.project, None)


def end(activity: Activity) -> None:
    """It is not under way any more."""
    if activity in _activities:
        _activities.remove(activity)


def say(project: Path, sentence: str, good: bool) -> None:
    """What came of the last work in a project, for the panel."""
    _last[project] = (sentence, good)


def said(project: Path) -> tuple[str, bool] | None:
    """(sentence, whether it is good news) of the last work that ended; None where none has since Blender was started."""
    return _last.get(project)


def stop() -> None:
    """Forget everything. What Blender does itself is stopped; jobs go on, and are found again."""
    for activity in list(_activities):
        if not activity.is_job:
            activity.work.cancel()
        end(activity)
    _last.clear()
