"""Baked scene and active camera to picture."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..core.errors import SnergError
from ..core.export.scene import read_scene
from ..core.grid.march import MarchSettings, march
from ..core.grid.snerg import Snerg
from ..snerg_addon.bridge import camera_from_blender, write_image
from ..snerg_addon.capture import evaluated
from ..snerg_addon.project import Project, project_of
from .job_runner import has_needed, redraw


class SNERG_OT_preview(bpy.types.Operator):
    """Render the baked scene from the active camera into the image "SNeRG Preview", as the web page will show it"""

    bl_idname = "snerg.preview"
    bl_label = "Preview"
    bl_options = {"REGISTER"}
    needs = "scene"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There must be a baked scene and a camera."""
        if not has_needed(cls, context):
            return False
        if context.scene.camera is None:
            cls.poll_message_set("The scene has no active camera")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """March here: it takes seconds, and needs only NumPy."""
        scene, manager = context.scene, context.window_manager
        manager.progress_begin(0, 1)
        try:
            camera = camera_from_blender(scene.camera, scene, evaluated(scene))
            snerg = loaded(project_of(scene))
            frame = march(snerg, camera, MarchSettings(), lambda fraction, message: manager.progress_update(fraction))
            pixels = frame.straight() if scene.snerg.transparent else frame.over(tuple(scene.snerg.background))
            image = write_image(pixels)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        finally:
            manager.progress_end()
        show(context, image)
        redraw()
        self.report({"INFO"}, f"Rendered {camera.width} x {camera.height} pixels from {camera.name} into {image.name}")
        return {"FINISHED"}


_loaded: tuple[Path, int, Snerg] | None = None


def loaded(project: Project) -> Snerg:
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
    if context.screen is None:
        return
    for area in context.screen.areas:
        if area.type == "IMAGE_EDITOR" and (area.spaces.active.image is None or area.spaces.active.image == image):
            area.spaces.active.image = image
            return
