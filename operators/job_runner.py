"""How every long verb runs: blocking when a script or background Blender calls it, with a timer, progress and Esc in the window."""

from __future__ import annotations

import sys
from typing import Any, ClassVar

import bpy

from ..core.errors import Cancelled, SnergError
from ..core.jobs.runner import Job
from ..snerg_addon import activity
from ..snerg_addon.project import Project, project_of

TICK_SECONDS = 0.2


class LongVerb:
    """Mixed into an operator, which says what to start and what to do with the result.

    step: the panel that shows it. label: what it is called while it runs. needs: the step of the project that must
    be there first.
    """

    step: ClassVar[str]
    label: ClassVar[str]
    needs: ClassVar[str] = ""

    def start(self, context: bpy.types.Context, project: Project) -> activity.Work:
        """Begin the work. Raises SnergError when something that it needs is missing."""
        raise NotImplementedError

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Take the result in, and say in one sentence what came of it. Raises SnergError."""
        raise NotImplementedError

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Blender's question whether the verb can run; the message says what is in the way."""
        busy = activity.current()
        if busy is not None:
            cls.poll_message_set(f"{busy.label} is still under way")  # type: ignore[attr-defined]
            return False
        return has_needed(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do it and wait."""
        scene, project = context.scene, project_of(context.scene)
        work: activity.Work | None = None
        try:
            work = self.start(context, project)
            return self._say(self.finish(scene, project, work.wait(_print_progress(self.label))))
        except SnergError as error:
            return self._fail(error, work)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Do it beside everything else, or wait where there is no window."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        self._scene_name, self._project = context.scene.name, project_of(context.scene)
        try:
            self._activity = activity.Activity(self.step, self.label, self.start(context, self._project))
            activity.begin(self._activity)
        except SnergError as error:
            return self._fail(error, None)
        manager = context.window_manager
        self._timer = manager.event_timer_add(TICK_SECONDS, window=context.window)
        manager.modal_handler_add(self)
        redraw()
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Every event of the window while it runs: only the timer's and Esc are ours."""
        work = self._activity.work
        if event.type == "ESC" and event.value == "PRESS" and not work.cancelling:
            work.cancel()
            redraw()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        running = work.poll()
        said = f"SNeRG: {self.label}, {work.fraction:.0%}. {work.message}. Esc stops it"
        context.workspace.status_text_set(said if running else None)
        redraw()
        if running:
            return {"PASS_THROUGH"}
        self._leave(context)
        if work.state != "done":
            return self._fail(Cancelled(work.error) if work.state == "cancelled" else SnergError(work.error), work)
        scene = bpy.data.scenes.get(self._scene_name) or context.scene
        try:
            return self._say(self.finish(scene, self._project, work.result))
        except SnergError as error:
            return self._fail(error, work)

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator itself: another file is loaded, or Blender closes."""
        self._activity.work.cancel()
        self._leave(context)

    def _leave(self, context: bpy.types.Context) -> None:
        activity.end()
        context.window_manager.event_timer_remove(self._timer)
        if context.workspace is not None:
            context.workspace.status_text_set(None)
        redraw()

    def _say(self, sentence: str) -> set[str]:
        self.report({"INFO"}, sentence)  # type: ignore[attr-defined]
        return {"FINISHED"}

    def _fail(self, error: SnergError, work: activity.Work | None) -> set[str]:
        if isinstance(work, Job) and not isinstance(error, Cancelled):
            print(*work.log, sep="\n", file=sys.stderr)
        self.report({"WARNING" if isinstance(error, Cancelled) else "ERROR"}, str(error))  # type: ignore[attr-defined]
        return {"CANCELLED"}


MISSING = {
    "dataset": "There is no dataset; render or import one",
    "field": "There is no field; train or import one",
    "scene": "There is no baked scene; bake or import one",
}


def has_needed(verb: type[Any], context: bpy.types.Context) -> bool:
    """Whether the step that `verb.needs` is there; sets the poll message where it is not."""
    if verb.needs and not project_of(context.scene).has(verb.needs):
        verb.poll_message_set(MISSING[verb.needs])
        return False
    return True


def _print_progress(label: str) -> Any:
    def say(fraction: float, message: str) -> None:
        print(f"SNeRG: {label} {fraction:4.0%} {message}", file=sys.stderr)

    return say


def redraw() -> None:
    """Draw the sidebars again, so that the panels show what is new."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "IMAGE_EDITOR"):
                area.tag_redraw()
