"""Open the exported web page."""

from __future__ import annotations

import bpy

from ..snerg_addon import page_server
from ..snerg_addon.project import project_of


class SNERG_OT_open_page(bpy.types.Operator):
    """Open the exported web page in the browser of this computer. It can be seen there until Blender closes"""

    bl_idname = "snerg.open_page"
    bl_label = "Open Web Page"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a page."""
        if not project_of(context.scene).has("web"):
            cls.poll_message_set("There is no web page; export one")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Serve the page's folder, and open its address."""
        try:
            address = page_server.address_of(project_of(context.scene).web)
        except OSError as error:
            self.report({"ERROR"}, f"The page could not be served to the browser: {error}; open its folder with a web server.")
            return {"CANCELLED"}
        bpy.ops.wm.url_open(url=address)
        self.report({"INFO"}, f"The web page is at {address} until Blender closes.")
        return {"FINISHED"}
