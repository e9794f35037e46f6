"""The farm panel: work that a Flamenco render farm does. It is there where a Manager is found."""

from __future__ import annotations

import bpy

from .. import flamenco
from .layout import SidebarPanel, draw_sentence

BUTTONS = (("FRAMES", "Send Frames", "RENDER_ANIMATION"), ("BAKES", "Send Bakes", "RENDER_STILL"), ("STUDY", "Send Study", "GRAPH"))


class SNERG_PT_farm(SidebarPanel, bpy.types.Panel):
    """Send work to a Flamenco render farm"""

    bl_label = "Render Farm"
    bl_idname = "SNERG_PT_farm"
    bl_parent_id = "SNERG_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a Manager answers."""
        answer = flamenco.manager()
        return answer is not None and answer.state in ("ready", "unready")

    def draw(self, context: bpy.types.Context) -> None:
        """Which Manager it is, and a button for each kind of work."""
        answer = flamenco.manager()
        if answer is None:
            return
        draw_sentence(self.layout.column(align=True), answer.text, answer.icon)
        column = self.layout.column(align=True)
        column.enabled = answer.state == "ready"
        for work, text, icon in BUTTONS:
            column.operator("snerg.send_to_flamenco", text=text, icon=icon).work = work
        self.layout.operator("snerg.ask_flamenco", icon="FILE_REFRESH")
