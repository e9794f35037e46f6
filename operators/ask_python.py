"""Ask the Python for training for its devices again."""

from __future__ import annotations

import bpy

from ..snerg_addon import training_python


class SNERG_OT_ask_python(bpy.types.Operator):
    """Ask the Python for training again which devices it has, after packages in it have changed"""

    bl_idname = "snerg.ask_python"
    bl_label = "Ask Again"
    bl_options = {"INTERNAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Forget the answer; the panels ask again when they are drawn."""
        training_python.ask_again()
        return {"FINISHED"}
