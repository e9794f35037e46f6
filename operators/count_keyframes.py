"""Count the keyframes of the camera move."""

from __future__ import annotations

import bpy

from ..core.errors import SnergError
from ..snerg_addon.camera_move import remember_count, summary
from .camera_move_operator import CameraMoveOperator


class SNERG_OT_count_keyframes(CameraMoveOperator, bpy.types.Operator):
    """Evaluate the camera at every frame, and say what its move adds to the page"""

    bl_idname = "snerg.count_keyframes"
    bl_label = "Count Keyframes"
    bl_options = {"REGISTER"}

    def needs_move(self, _context: bpy.types.Context) -> bool:
        """Always."""
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Keep the number and the size for the panel, and report them."""
        try:
            path = self.move_of(context)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        remember_count(context.scene, path)
        self.report({"INFO"}, f"The camera move has {summary(path)}")
        return {"FINISHED"}
