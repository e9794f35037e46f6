"""How every long verb runs: blocking when a script or background Blender calls it, beside everything else in the window."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..core.errors import Cancelled, SnergError
from ..core.jobs import folder as folders
from ..core.jobs.runner import Job
from ..snerg_addon import activity
from ..snerg_addon.activity import Activity
from ..snerg_addon.owner import claim, write_owner
from ..snerg_addon.project import Project, no_dataset, project_of


class LongVerb:
    """Mixed into an operator, which says what to start and what to do with the result.

    step: the panel that shows it. label: what it is called while it runs. needs: the step of the project that must
    be there first. queues: whether it can be started while a job makes that, behind which it then waits.
    """

    bl_idname: str
    step: ClassVar[str]
    label: ClassVar[str]
    needs: ClassVar[str] = ""
    queues: ClassVar[bool] = False

    def start(self, context: bpy.types.Context, project: Project) -> activity.Work:
        """The work: begun, or a job to begin. Raises SnergError when something that it needs is missing."""
        raise NotImplementedError

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Take the result in, and say in one sentence what came of it. Raises SnergError.

        It is also called for a job that an earlier session started: of the operator it may use what the class says and `report`.
        """
        raise NotImplementedError

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Blender's question whether the verb can run; the message says what is in the way."""
        return has_needed(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do it and wait."""
        scene, work = context.scene, None
        try:
            project, work = started(self, context)
            if isinstance(work, Job):
                work.begin(project.folder, record_of(self, scene), attached=True)
                assert work.folder is not None
                folders.take(work.folder)  # by this script, whatever comes of it
            return self._say(self.finish(scene, project, work.wait(_print_progress(self.label))))
        except SnergError as error:
            return self._fail(error, work)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Start it and leave it to the timer (watch.py), or wait where there is no window."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            launch(self, context)
        except SnergError as error:
            return self._fail(error, None)
        return {"FINISHED"}

    def _say(self, sentence: str) -> set[str]:
        self.report({"INFO"}, sentence)  # type: ignore[attr-defined]
        return {"FINISHED"}

    def _fail(self, error: SnergError, work: activity.Work | None) -> set[str]:
        if isinstance(work, Job) and not isinstance(error, Cancelled):
            print(*work.log, sep="\n", file=sys.stderr)
        self.report({"WARNING" if isinstance(error, Cancelled) else "ERROR"}, str(error))  # type: ignore[attr-defined]
        return {"CANCELLED"}


def launch(verb: LongVerb, context: bpy.types.Context) -> Activity:
    """Start an operator's work beside everything else. Raises SnergError when it cannot be, or is under way already."""
    scene, project, operator = context.scene, claimed(context.scene), type(verb).bl_idname  # of an instance it is SNERG_OT_...
    others = [other for other in activity.current(project.folder) if other.operator == operator]
    if any(not other.is_job for other in others):
        raise SnergError(f"{verb.label} is still under way; wait for it or stop it first.")
    work = verb.start(context, project)
    write_owner(project.folder, scene)
    if isinstance(work, Job):
        if any(isinstance(other.work, Job) and other.work.arguments == work.arguments for other in others):
            raise SnergError(f"{verb.label} with these settings is already under way; wait for it or stop it first.")
        work.begin(project.folder, record_of(verb, scene))
    begun = Activity(verb.step, verb.label, work, operator, project.folder, scene.name, scene.session_uid)
    activity.begin(begun)
    redraw()
    return begun


def started(verb: LongVerb, context: bpy.types.Context) -> tuple[Project, activity.Work]:
    """An operator's work, in a project that is the scene's own."""
    project = claimed(context.scene)
    work = verb.start(context, project)
    write_owner(project.folder, context.scene)
    return project, work


def claimed(scene: bpy.types.Scene) -> Project:
    """The scene's project, with its place fixed."""
    claim(scene)
    return project_of(scene)


def record_of(verb: LongVerb, scene: bpy.types.Scene) -> dict[str, Any]:
    """What a job's folder says of it."""
    return {"operator": type(verb).bl_idname, "step": verb.step, "label": verb.label, "scene": scene.name, "blend": bpy.data.filepath}


MISSING = {
    "dataset": "There is no dataset; render or import one",
    "field": "There is no field; train or import one",
    "scene": "There is no baked scene; bake or import one",
}


def has_needed(verb: type[Any], context: bpy.types.Context) -> bool:
    """Whether the step that `verb.needs` is there, or a job that this one can wait for makes it; sets the poll message where not."""
    project = project_of(context.scene)
    coming = verb.queues and any(busy.is_job and busy.step == verb.needs for busy in activity.current(project.folder))
    if not verb.needs or coming or project.has(verb.needs) or awaited(project, verb.needs):
        return True
    if verb.needs == "dataset" and context.scene.snerg.dataset:
        verb.poll_message_set(no_dataset(project))
    else:
        verb.poll_message_set(MISSING[verb.needs])
    return False


def awaited(project: Project, step: str) -> Path | None:
    """The new version of 'field' or 'scene' that a job under way makes, the last where there are several; None where none does."""
    verb = {"field": "train", "scene": "bake"}.get(step)
    for folder in reversed(folders.live_jobs(project.folder)):
        command = [str(part) for part in folders.read_record(folder).get("command", [])]
        if verb in command and "--out" in command[:-1]:
            return Path(command[command.index("--out") + 1])
    return None


def _print_progress(label: str) -> Any:
    def say(fraction: float, message: str) -> None:
        print(f"SNeRG: {label} {fraction:4.0%} {message}", file=sys.stderr)

    return say


def redraw() -> bool:
    """Draw the sidebars and the status bars again, so that they show what is new; False where a status bar has to wait."""
    drawn = True
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "IMAGE_EDITOR"):
                area.tag_redraw()
        if window.modal_operators:  # the status bar may hold a text of theirs, which this would take away
            drawn = False
        else:
            window.workspace.status_text_set_internal(None)
    return drawn
