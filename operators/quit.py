"""Leaving the file while jobs run. No add-on can hold Blender back, but the keys for it can ask first.

Left any other way, jobs run on; opening the file again finds them.
"""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations of properties as values, hence no postponed evaluation here.

import sys
from typing import Any

import bpy

from ..core.errors import SnergError
from ..snerg_addon import activity

KEYS = {"Q": "QUIT", "O": "OPEN", "N": "NEW"}  # Blender's own, all with Ctrl
TITLES = {"QUIT": "Quit Blender", "OPEN": "Open Another File", "NEW": "Begin a New File"}
_items: list[tuple[Any, Any]] = []


class SNERG_OT_quit(bpy.types.Operator):
    """Leave the file, asking first what becomes of the work that SNeRG has under way"""

    bl_idname = "snerg.quit"
    bl_label = "Leave the File"
    bl_options = {"INTERNAL"}

    jobs: bpy.props.EnumProperty(
        name="Work Under Way",
        items=[
            ("RUN", "Let It Run On", "It goes on by itself; opening the file again shows how it went"),
            ("STOP", "Stop It", "What was finished before is kept"),
        ],
        default="RUN",
        options={"SKIP_SAVE"},
    )
    then: bpy.props.EnumProperty(
        name="Then",
        items=[(key, title, "") for key, title in TITLES.items()],
        default="QUIT",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only while jobs run: else Blender goes on to what the key means without this add-on."""
        return any(begun.is_job for begun in activity.current())

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Ask."""
        title = TITLES[self.then]
        return set(context.window_manager.invoke_props_dialog(self, title=f"{title}?", confirm_text=title))

    def draw(self, _context: bpy.types.Context) -> None:
        """What is under way, and the choice."""
        layout = self.layout
        for begun in activity.current():
            layout.label(text=f"{begun.label}: {begun.task.text}", icon="SORTTIME" if begun.outlives else "ERROR")
            if not begun.is_job:
                layout.label(text="It ends in any case: Blender does it itself")
            elif not begun.outlives:
                layout.label(text="It ends with Blender: the file was never saved")
        layout.prop(self, "jobs", expand=True)

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Blender asks about unsaved changes itself."""
        if self.jobs == "STOP":
            try:
                for begun in activity.current():
                    begun.task.cancel()
            except SnergError as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
        if self.then == "QUIT":
            bpy.ops.wm.quit_blender("INVOKE_DEFAULT")
        elif self.then == "OPEN":
            bpy.ops.wm.open_mainfile("INVOKE_DEFAULT")
        else:
            bpy.ops.wm.call_menu(name="TOPBAR_MT_file_new")
        return {"FINISHED"}


def add_keys() -> None:
    """Come before Blender's own keys. There are no keys in background mode."""
    configuration = bpy.context.window_manager.keyconfigs.addon
    if configuration is None:
        return
    keymap, mac = configuration.keymaps.new(name="Window", space_type="EMPTY"), sys.platform == "darwin"
    for key, then in KEYS.items():
        item = keymap.keymap_items.new(SNERG_OT_quit.bl_idname, key, "PRESS", ctrl=not mac, oskey=mac)
        item.properties.then = then
        _items.append((keymap, item))


def remove_keys() -> None:
    """Give them back."""
    while _items:
        keymap, item = _items.pop()
        keymap.keymap_items.remove(item)
