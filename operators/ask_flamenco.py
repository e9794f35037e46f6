"""Ask the Flamenco Manager of the preferences again."""

from __future__ import annotations

import bpy

from ..snerg_addon import flamenco


class SNERG_OT_ask_flamenco(bpy.types.Operator):
    """Look for the Flamenco Manager again, after it was started or its job types have changed"""

    bl_idname = "snerg.ask_flamenco"
    bl_label = "Ask Again"
    bl_options = {"INTERNAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Forget the answer; the panels ask again when they are drawn."""
        flamenco.ask_again()
        return {"FINISHED"}
