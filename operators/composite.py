"""Composite with this render."""

from __future__ import annotations

import bpy

from ..core.errors import SnergError
from ..snerg_addon.composite import composite


class SNERG_OT_composite(bpy.types.Operator):
    """Show SNeRG objects among what this scene's engine renders: a second scene renders them, and compositor nodes merge both by depth"""

    bl_idname = "snerg.composite"
    bl_label = "Composite with This Render"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene has an engine of its own to composite with."""
        if context.scene.render.engine == "SNERG":
            cls.poll_message_set("Choose Cycles or EEVEE as the render engine; the engine SNeRG renders SNeRG objects alone")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set up the second scene and the nodes, or update them."""
        try:
            second = composite(context.scene, context.view_layer)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"F12 shows meshes and baked scenes together; {second.name!r} renders the baked ones.")
        return {"FINISHED"}
