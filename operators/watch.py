"""The one timer that polls all tasks: it finds the jobs of the open file, shows their progress, and finishes those that have ended.

A job belongs to its project, and not to the session or the window that started it: it is found by its folder, whether this session
started it, an earlier one, or another Blender. Its result is taken once, by the first Blender that finds it ended.
"""

from __future__ import annotations

import shutil
import traceback
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import SnergError
from ..core.jobs import folder as folders
from ..core.jobs.runner import Job
from ..snerg_addon import activity, flamenco, results, saving, steps, training_object, training_python
from ..snerg_addon.activity import Activity
from ..snerg_addon.project import project_of
from .task_operator import TaskOperator, redraw, remember_for_undo

TICK_SECONDS = 0.2  # between two calls of the timer
STATUS_BAR_WIDTH = 6  # of a task's bar in the status bar, in widths of a square button
STATUS_CHARACTERS = 120  # of the sentence there about the task that has ended
IDLE_SECONDS = 1.0  # between two calls while no task runs
_told: tuple[str, bool] | None = None  # what the status bar tells of a task that has ended
WHOLE_FILE = {"OBJECT", "POSE"}  # the modes in which an undo step holds the whole file
_stale = False  # whether something changed that is not drawn yet


def tick() -> float:
    """The timer's function. Returns the seconds until its next call."""
    global _stale
    try:
        _stale = any([training_python.poll(), flamenco.poll()]) or _stale or bool(activity.current()) or report_changed()
        saving.move_saved_projects()
        find()
        _stale = results.refresh() or _stale
        if windows := bpy.context.window_manager.windows:
            _stale = steps.follow(windows[0].scene) or _stale
        for running in activity.current():
            follow(running)
        training_object.show_trainings()
        if _stale or activity.current():
            _stale = not redraw()
    except Exception:  # Blender never calls a timer again that raised, and no task would end any more
        traceback.print_exc()
    return TICK_SECONDS if activity.current() else IDLE_SECONDS


def report_changed() -> bool:
    """Whether the status bar tells of another task that has ended, or of none any more, since the last call."""
    global _told
    before, _told = _told, activity.recent_report()
    return before != _told


def find() -> None:
    """Show the jobs of the open scenes' projects and no others. Cancel work inside Blender whose scene was deleted."""
    scenes = {project_of(scene).folder: scene for scene in reversed(bpy.data.scenes)}
    sessions = {scene.session_uid for scene in bpy.data.scenes}
    for running in activity.current():
        if not running.is_job and running.session not in sessions:
            running.task.cancel()
            activity.end(running)
        elif running.is_job and running.project not in scenes:
            activity.end(running)
    known = {running.key for running in activity.current()}
    for project, scene in scenes.items():
        for folder in folders.job_folders(project):
            if str(folder) not in known and not (folder / folders.TAKEN).exists():
                activity.begin(found(Job.found(folder), scene, project))


def found(job: Job, scene: bpy.types.Scene, project: Path) -> Activity:
    """The activity of a job that this session did not start, or started while another file was open."""
    texts = {name: str(job.record.get(name, "")) for name in ("step", "label", "operator", "scene")}
    named = bpy.data.scenes.get(texts["scene"])
    name = texts["scene"] if named is not None and project_of(named).folder == project else scene.name
    return Activity(texts["step"], texts["label"] or "A job", job, texts["operator"], project, name)


def follow(running: Activity) -> None:
    """Poll its task. When the task has ended, finish it and report the outcome."""
    task, operator = running.task, operator_class(running.operator)
    if task.poll():
        return
    if task.state == "done" and operator is not None and operator.changes_file and (reason := cannot_undo_now()):
        task.text = reason
        return
    activity.end(running)
    if isinstance(task, Job) and task.folder is not None:
        shutil.rmtree(task.folder / folders.INPUT, ignore_errors=True)  # left there by a job that was killed
        training_object.discard_preview(running)
        if not folders.take(task.folder):
            return
    if task.state == "done":
        activity.report(running.project, *take_result(running))
    else:
        activity.report(running.project, f"{running.label}: {task.error}", False)
        if isinstance(task, Job) and task.state == "failed":
            print(*task.log, sep="\n")


def take_result(running: Activity) -> tuple[str, bool]:
    """Let its operator finish. Returns the sentence to report, and whether all went well."""
    scene, operator = bpy.data.scenes.get(running.scene), operator_class(running.operator)
    if scene is None or operator is None:
        return f"{running.label} has ended; its result is in {running.project}.", True
    finisher = Finisher(operator)
    try:
        sentence = finisher.finish(scene, project_of(scene), running.task.result)
    except SnergError as error:
        return str(error), False
    except Exception as error:  # a damaged result, or a bug: the panel must not wait for ever
        traceback.print_exc()
        return f"The result could not be used ({type(error).__name__}: {error}); see Blender's console for details.", False
    if operator.changes_file:
        remember_for_undo(running.label)
    return " ".join([sentence, *finisher.warnings]), not finisher.warnings


class Finisher:
    """Stands in for the instance of an operator, which Blender deleted long ago: its class's attributes, and `report`."""

    def __init__(self, operator: Any) -> None:
        self._operator = operator
        self.warnings: list[str] = []

    def report(self, _kinds: set[str], text: str) -> None:
        """Keep a warning for the panel."""
        self.warnings.append(text)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._operator, name)
        return value.__get__(self) if callable(value) and not isinstance(value, type) and not hasattr(value, "__self__") else value


def operator_class(name: str) -> Any:
    """The task operator with that bl_idname; None where there is none."""
    from . import classes

    return next((cls for cls in classes() if issubclass(cls, TaskOperator) and getattr(cls, "bl_idname", None) == name), None)


def cannot_undo_now() -> str:
    """Why what a task made cannot become an undo step now, a few words; '' where it can.

    A step that Blender takes in Edit Mode holds the mesh alone: an object made then would be lost by undo and not be brought back by redo.
    """
    for window in bpy.context.window_manager.windows:
        active = window.view_layer.objects.active
        if active is not None and active.mode not in WHOLE_FILE:
            return "Ready; leave " + active.mode.replace("_", " ").title() + " Mode to get the result"
        if any(operator.bl_idname.startswith("TRANSFORM_") for operator in window.modal_operators):
            return "Ready; finish the transform to get the result"
    return ""


def draw_status(header: bpy.types.Header, _context: bpy.types.Context) -> None:
    """Draw each activity with its bar at the end of the status bar, in every window and workspace; or how the last one has ended."""
    for running in activity.current():
        row = header.layout.row(align=True)
        row.label(text=f"SNeRG: {running.label}", icon="PAUSE" if running.task.state == "waiting" else "SORTTIME")
        bar = row.row(align=True)
        bar.ui_units_x = STATUS_BAR_WIDTH
        bar.progress(factor=running.task.fraction, text=f"{running.task.fraction:.0%}")
    if report := activity.recent_report():
        header.layout.label(text=f"SNeRG: {report[0][:STATUS_CHARACTERS]}", icon="CHECKMARK" if report[1] else "ERROR")


def register() -> None:
    """Start the timer. A persistent timer continues when another file is opened."""
    bpy.types.STATUSBAR_HT_header.append(draw_status)
    if not bpy.app.background:  # in background mode nothing calls timers
        bpy.app.timers.register(tick, first_interval=IDLE_SECONDS, persistent=True)


def unregister() -> None:
    """Stop the timer."""
    bpy.types.STATUSBAR_HT_header.remove(draw_status)
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    training_object.remove_all()
    activity.stop()
