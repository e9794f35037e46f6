"""Count the keyframes of the camera move."""

from __future__ import annotations

import bpy

from ..core.errors import SnergError
from ..snerg_addon.camera_move import camera_move, remember_count, scene_box, summary
from ..snerg_addon.project import project_of


class SNERG_OT_count_keyframes(bpy.types.Operator):
    """Evaluate the camera at every frame, and say what its move adds to the page"""

    bl_idname = "snerg.count_keyframes"
    bl_label = "Count Keyframes"
    bl_options = {"REGISTER"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Keep the number and the size for the panel, and report them."""
        project = project_of(context.scene)
        try:
            path = camera_move(context.scene, scene_box(project.scene) if project.has("scene") else None)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        remember_count(context.scene, path)
        self.report({"INFO"}, f"The camera move has {summary(path)}")
        return {"FINISHED"}
