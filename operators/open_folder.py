"""Show the project's files."""

from __future__ import annotations

import bpy

from ..snerg_addon.project import project_of


class SNERG_OT_open_folder(bpy.types.Operator):
    """Show the project's folder in the system's file browser"""

    bl_idname = "snerg.open_folder"
    bl_label = "Show Files"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the folder exists yet."""
        if not project_of(context.scene).folder.is_dir():
            cls.poll_message_set("The project is still empty")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Open the folder in the system's file browser."""
        bpy.ops.wm.path_open(filepath=str(project_of(context.scene).folder))
        return {"FINISHED"}
