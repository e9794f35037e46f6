"""Show a step's files."""

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
        """The folder exists once a step has left something."""
        if not project_of(context.scene).folder.is_dir():
            cls.poll_message_set("Nothing has been made yet")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Hand the folder to the system."""
        bpy.ops.wm.path_open(filepath=str(project_of(context.scene).folder))
        return {"FINISHED"}
