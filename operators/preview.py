"""Baked scene and active camera to picture."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.errors import Cancelled, SnergError
from ..core.export.scene_files import read_scene
from ..core.geometry.camera import Camera
from ..core.jobs.runner import State, outcome
from ..core.nerf.frame import Frame
from ..core.rendering.render import PREVIEW_TOLERANCE, MarchSettings, render_progressively
from ..core.scene.scene import Scene
from ..snerg_addon.activity import Work
from ..snerg_addon.bridge import camera_from_blender, write_image
from ..snerg_addon.capture import evaluated
from ..snerg_addon.project import Project
from .job_runner import LongVerb, redraw


class SNERG_OT_preview(LongVerb, bpy.types.Operator):
    """Render the baked scene from the active camera into the image "SNeRG Preview", as the web page will show it"""

    bl_idname = "snerg.preview"
    bl_label = "Preview"
    bl_options = {"REGISTER"}
    step, label, needs = "preview", "Rendering the preview", "scene"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There must be a baked scene and a camera."""
        if not super().poll(context):
            return False
        if context.scene.camera is None:
            cls.poll_message_set("The scene has no active camera")
            return False
        return True

    def start(self, context: bpy.types.Context, project: Project) -> Work:
        """March in a thread: it needs only NumPy."""
        scene = context.scene
        camera = camera_from_blender(scene.camera, scene, evaluated(scene))
        background = None if scene.snerg.transparent else tuple(scene.snerg.background)

        def shown(frame: Frame) -> None:
            pixels = frame.straight() if background is None else frame.over(background)
            show(bpy.context, write_image(enlarged(pixels, camera.width, camera.height)))
            redraw()

        return Marching(project, camera, shown)

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """What was rendered."""
        return "Rendered {width} x {height} pixels from {camera}".format(**result)


class Marching:
    """A preview under way in a thread of its own; whatever touches Blender happens in `poll`, so that it is seen as it grows finer.

    shown: called with every picture, in the thread that polls.
    """

    def __init__(self, project: Project, camera: Camera, shown: Callable[[Frame], None]) -> None:
        self.state: State = "running"
        self.fraction, self.message = 0.0, "Reading the scene"
        self.notes: list[str] = []
        self.result: dict[str, Any] = {}
        self.error = ""
        self._project, self._camera, self._shown = project, camera, shown
        self._frame: Frame | None = None
        self._problem: Exception | None = None
        self._stop, self._changed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._march, daemon=True)
        self._thread.start()

    @property
    def cancelling(self) -> bool:
        """Told to stop, and not yet stopped."""
        return self.state == "running" and self._stop.is_set()

    def poll(self) -> bool:
        """Show what is new; True while there is more to come."""
        if self.state != "running":
            return False
        ended = not self._thread.is_alive()  # asked first: a last frame is there by then
        self._changed.clear()
        frame, self._frame = self._frame, None
        if frame is not None and not self._stop.is_set():
            self._shown(frame)
        if not ended:
            return True
        self._end()
        return False

    def cancel(self) -> None:
        """Stop within a few hundredths of a second."""
        self._stop.set()

    def wait(self, progress: Callable[[float, str], None] | None = None) -> dict[str, Any]:
        """Until it is done; returns the result. Raises as Job.wait does."""
        try:
            while self.poll():
                if progress:
                    progress(self.fraction, self.message)
                self._changed.wait(0.2)
        except BaseException:
            self.cancel()
            self._thread.join()
            raise
        return outcome(self.state, self.result, self.error)

    def _march(self) -> None:
        try:
            for frame in render_progressively(loaded(self._project), self._camera, MarchSettings(PREVIEW_TOLERANCE), self._tell):
                self._frame = frame
                self._changed.set()
        except Exception as error:  # handed to the thread that polls
            self._problem = error
        self._changed.set()

    def _tell(self, fraction: float, message: str) -> None:
        self.fraction, self.message = fraction, message
        if self._stop.is_set():
            raise Cancelled("Stopped as you asked.")

    def _end(self) -> None:
        problem = self._problem
        if problem is None:
            self.state, self.fraction = "done", 1.0
            self.result = {"width": self._camera.width, "height": self._camera.height, "camera": self._camera.name}
        elif isinstance(problem, Cancelled):
            self.state, self.error = "cancelled", str(problem)
        else:
            self.state, self.error = "failed", str(problem)
            if not isinstance(problem, SnergError):
                traceback.print_exception(problem)
                self.error = f"The preview went wrong ({type(problem).__name__}: {problem}); Blender's console says where."


def enlarged(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """[h, w, C] to [height, width, C] by repeating pixels, so that a first small picture takes the place of the whole one."""
    times = -(-height // pixels.shape[0])
    return pixels.repeat(times, axis=0).repeat(times, axis=1)[:height, :width] if times > 1 else pixels


_loaded: tuple[Path, int, Scene] | None = None


def loaded(project: Project) -> Scene:
    """The project's baked scene, kept in memory until its files change."""
    global _loaded
    try:
        stamp = (project.scene / "scene.json").stat().st_mtime_ns
    except OSError as error:
        raise SnergError(f"There is no baked scene in {project.scene}; bake or import one first.") from error
    if _loaded is None or _loaded[:2] != (project.scene, stamp):
        _loaded = (project.scene, stamp, read_scene(project.scene))
    return _loaded[2]


def show(context: bpy.types.Context, image: bpy.types.Image) -> None:
    """Put the picture into the first image editor that shows nothing else of the artist's."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR" and (area.spaces.active.image is None or area.spaces.active.image == image):
                area.spaces.active.image = image
                return
