"""Render the baked scene from the active camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.errors import SnergError
from ..core.export.scene_files import read_scene
from ..core.geometry.camera import Camera
from ..core.jobs.task import Task, ThreadTask
from ..core.nerf.frame import Frame
from ..core.progress import Progress
from ..core.rendering.render import PREVIEW_TOLERANCE, MarchSettings, render_progressively
from ..core.scene.scene import Scene
from ..snerg_addon.bridge import PREVIEW, show_image, write_image
from ..snerg_addon.project import Project
from ..snerg_addon.render_evaluation import evaluated_cameras
from .task_operator import TaskOperator, redraw


class SNERG_OT_preview(TaskOperator, bpy.types.Operator):
    """Render the baked scene from the active camera into the image "SNeRG Preview", as the web page will show it"""

    bl_idname = "snerg.preview"
    bl_label = "Preview"
    bl_options = {"REGISTER"}
    step, label, needs = "preview", "Rendering the preview", "scene"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there are a baked scene and an active camera."""
        if not super().poll(context):
            return False
        if context.scene.camera is None:
            cls.poll_message_set("The scene has no active camera")
            return False
        return True

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """Render in a thread, which needs only NumPy."""
        scene = context.scene
        (camera,) = evaluated_cameras(scene, [scene.camera])
        background = None if scene.snerg.transparent else tuple(scene.snerg.background)

        opened = bpy.app.background or context.preferences.view.render_display_type == "NONE"

        def show(frame: Frame) -> None:
            nonlocal opened
            pixels = frame.straight() if background is None else frame.over(background)
            image = write_image(enlarged(pixels, camera.width, camera.height))
            if not opened:  # once: the artist may close it while the passes come
                show_image(image)
                opened = True
            redraw()

        return PreviewTask(project, camera, show)

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Say what was rendered."""
        return "Rendered {width} x {height} pixels from {camera}".format(**result)


class SNERG_OT_show_preview(bpy.types.Operator):
    """Show the image "SNeRG Preview" in an image editor, or in a window of its own"""

    bl_idname = "snerg.show_preview"
    bl_label = "Show Preview"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a preview, and a window to show it in."""
        return PREVIEW in bpy.data.images and not bpy.app.background

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Show it."""
        show_image(bpy.data.images[PREVIEW])
        return {"FINISHED"}


class PreviewTask(ThreadTask):
    """Renders the preview in a thread, in several passes from coarse to fine. result: "width", "height" (pixels) and "camera" (its name).

    show: called with each pass [h, w] in the thread that polls, because Blender's data may not be changed in another.
    """

    def __init__(self, project: Project, camera: Camera, show: Callable[[Frame], None]) -> None:
        self._frame: Frame | None = None
        self._show = show
        super().__init__(lambda progress: self._march(project, camera, progress), "Reading the scene")

    def _march(self, project: Project, camera: Camera, progress: Progress) -> dict[str, Any]:
        for frame in render_progressively(loaded(project), camera, MarchSettings(PREVIEW_TOLERANCE), progress):
            self._frame = frame
            self.news.set()
        return {"width": camera.width, "height": camera.height, "camera": camera.name}

    def _advance(self) -> None:
        super()._advance()  # first: where the thread has ended, its last frame is there now
        frame, self._frame = self._frame, None
        if frame is not None and self.state not in ("cancelling", "cancelled"):
            self._show(frame)


def enlarged(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Pixels [h, w, C] repeated to [height, width, C], so that a coarse pass fills the whole image."""
    times = max(-(-height // pixels.shape[0]), -(-width // pixels.shape[1]))
    return pixels.repeat(times, axis=0).repeat(times, axis=1)[:height, :width] if times > 1 else pixels


_loaded: tuple[Path, int, Scene] | None = None


def loaded(project: Project) -> Scene:
    """The project's baked scene, cached until its files change. Raises SnergError where there is none."""
    global _loaded
    try:
        stamp = (project.scene / "scene.json").stat().st_mtime_ns
    except OSError as error:
        raise SnergError(f"There is no baked scene in {project.scene}; bake or import one first.") from error
    if _loaded is None or _loaded[:2] != (project.scene, stamp):
        _loaded = (project.scene, stamp, read_scene(project.scene))
    return _loaded[2]
