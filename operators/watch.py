"""The one timer that watches all work: it finds the jobs of the open file, shows how they go, and takes in what came of them.

A job belongs to its project, not to the session or the window that started it: it is found by its folder, whether this session
started it, one before, or another Blender. Its result is taken in once, by whoever finds it ended first.
"""

from __future__ import annotations

import shutil
import traceback
from typing import Any

import bpy

from ..core.errors import SnergError
from ..core.jobs import folder as folders
from ..core.jobs.runner import Job
from ..snerg_addon import activity, saving
from ..snerg_addon.activity import Activity
from ..snerg_addon.project import project_of
from .job_runner import LongVerb, redraw

TICK_SECONDS = 0.2
IDLE_SECONDS = 1.0  # between looks where nothing is under way
_stale = False  # whether something that is shown has changed since


def tick() -> float:
    """What the timer does; returns the seconds until it shall do it again."""
    global _stale
    try:
        _stale = _stale or bool(activity.current())
        saving.settle_all()
        find()
        for begun in activity.current():
            follow(begun)
        if _stale or activity.current():
            _stale = not redraw()
    except Exception:  # a timer that raises is never called again, and nothing would be taken in any more
        traceback.print_exc()
    return TICK_SECONDS if activity.current() else IDLE_SECONDS


def find() -> None:
    """Show the jobs of the open scenes' projects, and no others'; stop what Blender did itself for a scene that is gone."""
    scenes = {project_of(scene).folder: scene for scene in reversed(bpy.data.scenes)}
    sessions = {scene.session_uid for scene in bpy.data.scenes}
    for begun in activity.current():
        if not begun.is_job and begun.session not in sessions:
            begun.work.cancel()
            activity.end(begun)
        elif begun.is_job and begun.project not in scenes:
            activity.end(begun)
    known = {begun.key for begun in activity.current()}
    for project, scene in scenes.items():
        for folder in folders.job_folders(project):
            if str(folder) not in known and not (folder / folders.TAKEN).exists():
                activity.begin(found(Job.found(folder), scene, project))


def found(job: Job, scene: bpy.types.Scene, project: Any) -> Activity:
    """A job that this session did not start, or started for another file."""
    texts = {name: str(job.record.get(name, "")) for name in ("step", "label", "operator", "scene")}
    named = bpy.data.scenes.get(texts["scene"])
    name = texts["scene"] if named is not None and project_of(named).folder == project else scene.name
    return Activity(texts["step"], texts["label"] or "A job", job, texts["operator"], project, name)


def follow(begun: Activity) -> None:
    """See how it goes; when it has ended, say what came of it."""
    work = begun.work
    if work.poll():
        return
    activity.end(begun)
    if isinstance(work, Job) and work.folder is not None:
        shutil.rmtree(work.folder / folders.INPUT, ignore_errors=True)  # which a job that was killed left
        if not folders.take(work.folder):
            return
    if work.state == "done":
        activity.say(begun.project, *take_in(begun))
    else:
        activity.say(begun.project, f"{begun.label}: {work.error}", False)
        if isinstance(work, Job) and work.state == "failed":
            print(*work.log, sep="\n")


def take_in(begun: Activity) -> tuple[str, bool]:
    """Let its operator finish; returns what to say, and whether that is good news."""
    scene, verb = bpy.data.scenes.get(begun.scene), operator_class(begun.operator)
    if scene is None or verb is None:
        return f"{begun.label} has ended; its result is in {begun.project}.", True
    finisher = Finisher(verb)
    try:
        sentence = finisher.finish(scene, project_of(scene), begun.work.result)
    except SnergError as error:
        return str(error), False
    except Exception as error:  # of a result that was damaged, or a bug: either way the panel must not wait for ever
        traceback.print_exc()
        return f"The result could not be taken in ({type(error).__name__}: {error}); Blender's console says where.", False
    if "UNDO" in getattr(verb, "bl_options", ()):
        remember_for_undo(begun.label)
    return " ".join([sentence, *finisher.warnings]), not finisher.warnings


class Finisher:
    """Stands in for an operator whose work has ended, of which Blender keeps no instance: its class, and a `report`."""

    def __init__(self, operator: Any) -> None:
        self._operator = operator
        self.warnings: list[str] = []

    def report(self, _kinds: set[str], text: str) -> None:
        """For the panel."""
        self.warnings.append(text)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._operator, name)
        return value.__get__(self) if callable(value) and not isinstance(value, type) and not hasattr(value, "__self__") else value


def operator_class(name: str) -> Any:
    """The long verb of that bl_idname; None where there is none."""
    from . import classes

    return next((verb for verb in classes() if issubclass(verb, LongVerb) and getattr(verb, "bl_idname", None) == name), None)


def remember_for_undo(label: str) -> None:
    """A step of undo, which Blender made before there was anything to undo."""
    windows = bpy.context.window_manager.windows
    if windows:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message=label)


def draw_status(header: bpy.types.Header, _context: bpy.types.Context) -> None:
    """At the end of the status bar, in every window and workspace."""
    for begun in activity.current():
        header.layout.label(text=f"SNeRG: {begun.label}, {begun.work.fraction:.0%}")


def register() -> None:
    """Begin to watch. A timer that persists goes on when another file is opened."""
    bpy.types.STATUSBAR_HT_header.append(draw_status)
    if not bpy.app.background:  # where nothing calls timers
        bpy.app.timers.register(tick, first_interval=IDLE_SECONDS, persistent=True)


def unregister() -> None:
    """Watch no more."""
    bpy.types.STATUSBAR_HT_header.remove(draw_status)
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    activity.stop()
