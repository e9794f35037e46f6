"""The tasks that Blender's window shows and can stop: jobs of the open projects, and work inside Blender itself."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..core.jobs.runner import Job
from ..core.jobs.task import Task


@dataclass
class Activity:
    """A task that the window shows.

    step: the panel that shows it ('dataset', 'field', ...). label: what it is called ('Training'). operator: the bl_idname of the
    operator that started it. project: the project's folder. scene: the name of the scene that it was started in. session: that scene's
    session_uid, which stays the same while the file is open.
    """

    step: str
    label: str
    task: Task
    operator: str = ""
    project: Path = Path()
    scene: str = ""
    session: int = 0

    @property
    def key(self) -> str:
        """Identifies it among all: the folder of a job, else a number."""
        folder = self.task.folder if isinstance(self.task, Job) else None
        return str(folder) if folder else f"{id(self.task):x}"

    @property
    def is_job(self) -> bool:
        """Whether it is a process of its own, and not work inside Blender."""
        return isinstance(self.task, Job)

    @property
    def outlives(self) -> bool:
        """Whether it continues when Blender closes: a job does, unless its project lies in Blender's temporary folder."""
        return self.is_job and Path(bpy.app.tempdir) not in self.project.parents


_activities: list[Activity] = []
RECENT_SECONDS = 20.0  # for which the status bar tells how a task has ended
_reports: dict[Path, tuple[str, bool]] = {}
_last: tuple[float, Path] | None = None  # when the last report came, and of which project


def current(project: Path | None = None) -> list[Activity]:
    """The activities that have not ended, the oldest first: of all open projects, or of the one whose folder is given."""
    return [activity for activity in _activities if project is None or activity.project == project]


def begin(activity: Activity) -> None:
    """Show an activity from now on, in place of the project's last report."""
    _activities.append(activity)
    _reports.pop(activity.project, None)


def end(activity: Activity) -> None:
    """Show an activity no longer."""
    if activity in _activities:
        _activities.remove(activity)


def report(project: Path, sentence: str, good: bool) -> None:
    """Set the sentence that the panel shows about the last task of a project. good: whether the task succeeded."""
    global _last
    _reports[project] = (sentence, good)
    _last = time.monotonic(), project


def last_report(project: Path) -> tuple[str, bool] | None:
    """(sentence, whether the task succeeded) of a project's last task; None where none has ended since Blender was started."""
    return _reports.get(project)


def recent_report() -> tuple[str, bool] | None:
    """(sentence, whether the task succeeded) of the task that has just ended; None where none has, or another runs already."""
    if _last is None or time.monotonic() - _last[0] > RECENT_SECONDS or _activities:
        return None
    report = _reports.get(_last[1])
    return None if report is None else (within(_last[1], report[0]), report[1])


def within(project: Path, sentence: str) -> str:
    """A sentence in which the paths of the project's files begin in its folder: that folder's own path is long."""
    return sentence.replace(f"{project}{os.sep}", "")


def stop() -> None:
    """Forget all activities. Work inside Blender is cancelled; jobs continue, and are found again."""
    for activity in list(_activities):
        if not activity.is_job:
            activity.task.cancel()
        end(activity)
    _reports.clear()
