"""The base of operators that need the camera's move: with a window, its frames are evaluated in slices, and Esc stops it."""

from __future__ import annotations

import time
from collections.abc import Generator

import bpy

from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..core.geometry.camera_path import CameraPath
from ..snerg_addon.camera_move import SLICE_SECONDS, camera_move, camera_move_steps, scene_box
from ..snerg_addon.project import project_of
from .task_operator import redraw

PAUSE_SECONDS = 0.01  # between two slices: Blender draws, and takes in keys


class CameraMoveOperator:
    """Mixed into an operator. The subclass says whether it needs the move now, and goes on with `move_of`."""

    _move: CameraPath | None = None  # once its frames are evaluated
    _steps: Generator[tuple[float, str], None, CameraPath]
    _timer: bpy.types.Timer

    def needs_move(self, context: bpy.types.Context) -> bool:
        """Whether what the operator is to do needs the move."""
        raise NotImplementedError

    def go_on(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Do the operator's work, with `move_of`."""
        return set(self.execute(context))  # type: ignore[attr-defined]

    def move_of(self, context: bpy.types.Context) -> CameraPath:
        """The move: evaluated already, or now, without a pause. Raises SnergError as `camera_move` does."""
        if self._move is None:
            self._move = camera_move(context.scene, box_of_move(context))
        return self._move

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Evaluate the move while the window answers, then go on."""
        if bpy.app.background or context.window is None or not self.needs_move(context):
            return self.go_on(context, event)
        try:
            self._steps = camera_move_steps(context.scene, box_of_move(context), SLICE_SECONDS)
        except SnergError as error:
            return self._refuse(str(error))
        manager = context.window_manager
        manager.progress_begin(0, 100)
        self._timer = manager.event_timer_add(PAUSE_SECONDS, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Take the next slice. Other events than Esc wait: nothing changes between two slices."""
        if event.type == "ESC":
            self.cancel(context)
            self.report({"WARNING"}, "The camera move was stopped; nothing was made of it.")  # type: ignore[attr-defined]
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        until = time.monotonic() + SLICE_SECONDS
        try:
            while time.monotonic() < until:
                fraction, text = next(self._steps)
        except StopIteration as end:
            self._move = end.value
            self.cancel(context)
            return self.go_on(context, event)
        except SnergError as error:
            self.cancel(context)
            return self._refuse(str(error))
        context.window_manager.progress_update(100 * fraction)
        context.workspace.status_text_set(f"SNeRG: camera move, {text}. Esc stops it.")
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """End the evaluation, also where Blender ends the operator."""
        self._steps.close()
        context.window_manager.event_timer_remove(self._timer)
        context.window_manager.progress_end()
        context.workspace.status_text_set(None)
        redraw()

    def _refuse(self, sentence: str) -> set[str]:
        self.report({"ERROR"}, sentence)  # type: ignore[attr-defined]
        return {"CANCELLED"}


def box_of_move(context: bpy.types.Context) -> Box | None:
    """The box of the baked scene; None where there is none."""
    project = project_of(context.scene)
    return scene_box(project.scene) if project.has("scene") else None
