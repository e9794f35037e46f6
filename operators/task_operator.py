"""The base of every operator that runs a long task: it blocks when a script or background Blender calls it, else the window stays free."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..core.errors import Cancelled, SnergError
from ..core.jobs import folder as folders
from ..core.jobs.runner import Job
from ..core.jobs.task import Task
from ..core.progress import Progress
from ..snerg_addon import activity
from ..snerg_addon.activity import Activity
from ..snerg_addon.owner import assign_project, write_owner
from ..snerg_addon.project import Project, no_dataset, project_of


class TaskOperator:
    """Mixed into an operator. The subclass says which task to start and what to do with its result.

    step: the panel that shows the task. label: what the task is called. needs: the step of the project that must be there first.
    queues: whether the task can be started while a job still makes what it needs; it then waits for that job.
    changes_file: whether `finish` changes the .blend. It is an undo step then; the start of a task is none, hence no UNDO in bl_options.
    """

    bl_idname: str
    step: ClassVar[str]
    label: ClassVar[str]
    needs: ClassVar[str] = ""
    queues: ClassVar[bool] = False
    changes_file: ClassVar[bool] = False

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """The task: running already, or a job to begin. Raises SnergError where something that it needs is missing."""
        raise NotImplementedError

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Put the result into the scene and the project, and return one sentence that says what was made. Raises SnergError.

        It is also called for jobs of an earlier session, without an instance: it may use only class attributes and `report`.
        """
        raise NotImplementedError

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether what the operator needs is there; the poll message says what is missing."""
        return has_needed(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Run the task and wait for it."""
        scene, task = context.scene, None
        try:
            project = scene_project(scene)
            task = self.start(context, project)
            write_owner(project.folder, scene)
            if isinstance(task, Job):
                task.begin(project.folder, record_of(self, scene), attached=True)
                assert task.folder is not None
                folders.take(task.folder)  # this script handles the result, and no window does
            sentence = self.finish(scene, project, task.wait(_print_progress(self.label)))
            if self.changes_file:
                remember_for_undo(self.label)
            return self._succeed(sentence)
        except SnergError as error:
            return self._fail(error, task)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Start the task and leave it to the timer (watch.py); without a window, run it and wait."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            launch(self, context)
        except SnergError as error:
            return self._fail(error, None)
        return {"FINISHED"}

    def _succeed(self, sentence: str) -> set[str]:
        self.report({"INFO"}, sentence)  # type: ignore[attr-defined]
        return {"FINISHED"}

    def _fail(self, error: SnergError, task: Task | None) -> set[str]:
        if isinstance(task, Job) and not isinstance(error, Cancelled):
            print(*task.log, sep="\n", file=sys.stderr)
        self.report({"WARNING" if isinstance(error, Cancelled) else "ERROR"}, str(error))  # type: ignore[attr-defined]
        return {"CANCELLED"}


def hand_over(operator: bpy.types.Operator, name: str, how: str, **keywords: Any) -> set[str]:
    """Let another operator of the add-on do the work, and report its error as this one's: Blender makes an exception of it."""
    try:
        return set(getattr(bpy.ops.snerg, name)(how, **keywords))
    except RuntimeError as error:
        operator.report({"ERROR"}, str(error).strip().removeprefix("Error: "))
        return {"CANCELLED"}


def remember_for_undo(label: str) -> None:
    """Push an undo step with what a task made."""
    windows = bpy.context.window_manager.windows
    with bpy.context.temp_override(window=windows[0]) if windows else nullcontext():
        if bpy.ops.ed.undo_push.poll():
            bpy.ops.ed.undo_push(message=label)


def launch(operator: TaskOperator, context: bpy.types.Context) -> Activity:
    """Start an operator's task without waiting for it. Raises SnergError when it cannot be started, or runs already."""
    scene, project, name = context.scene, scene_project(context.scene), type(operator).bl_idname  # an instance's bl_idname is SNERG_OT_...
    others = [other for other in activity.current(project.folder) if other.operator == name]
    if any(not other.is_job for other in others):
        raise SnergError(f"{operator.label} is still running; wait for it or stop it first.")
    task = operator.start(context, project)
    write_owner(project.folder, scene)
    if isinstance(task, Job):
        if any(isinstance(other.task, Job) and other.task.arguments == task.arguments for other in others):
            raise SnergError(f"{operator.label} with these settings is already running; wait for it or stop it first.")
        task.begin(project.folder, record_of(operator, scene))
    started = Activity(operator.step, operator.label, task, name, project.folder, scene.name, scene.session_uid)
    activity.begin(started)
    redraw()
    return started


def scene_project(scene: bpy.types.Scene) -> Project:
    """The scene's project, whose folder stays the same from now on."""
    assign_project(scene)
    return project_of(scene)


def record_of(operator: TaskOperator, scene: bpy.types.Scene) -> dict[str, Any]:
    """The entries of a job's job.json by which a later session finishes the job."""
    return {
        "operator": type(operator).bl_idname,
        "step": operator.step,
        "label": operator.label,
        "scene": scene.name,
        "blend": bpy.data.filepath,
    }


MISSING = {
    "dataset": "There is no dataset; render or import one",
    "field": "There is no field; train or import one",
    "scene": "There is no baked scene; bake or import one",
}


def has_needed(operator: type[Any], context: bpy.types.Context) -> bool:
    """Whether the step that the operator needs is there, or a job makes it that this one can wait for; else sets the poll message."""
    project = project_of(context.scene)
    coming = operator.queues and any(other.is_job and other.step == operator.needs for other in activity.current(project.folder))
    if not operator.needs or coming or project.has(operator.needs) or awaited(project, operator.needs):
        return True
    if operator.needs == "dataset" and context.scene.snerg.dataset:
        operator.poll_message_set(no_dataset(project))
    else:
        operator.poll_message_set(MISSING[operator.needs])
    return False


def awaited(project: Project, step: str) -> Path | None:
    """The version of 'field' or 'scene' that the newest live job writes; None where none does."""
    name = {"field": "train", "scene": "bake"}.get(step)
    for folder in reversed(folders.live_jobs(project.folder)):
        command = [str(part) for part in folders.read_record(folder).get("command", [])]
        if name in command and "--out" in command[:-1]:
            return Path(command[command.index("--out") + 1])
    return None


def _print_progress(label: str) -> Progress:
    def show(fraction: float, text: str) -> None:
        print(f"SNeRG: {label} {fraction:4.0%} {text}", file=sys.stderr)

    return show


def redraw() -> bool:
    """Redraw the sidebars and the status bars. Returns False where a status bar could not be redrawn yet."""
    drawn = True
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "IMAGE_EDITOR", "PREFERENCES"):
                area.tag_redraw()
        if window.modal_operators:  # the status bar may hold a text of theirs, which this would clear
            drawn = False
        else:
            window.workspace.status_text_set_internal(None)
    return drawn
