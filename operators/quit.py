"""Closing the file while jobs run. An add-on cannot keep Blender from closing a file, but the keys for it can ask first.

If the file is closed in another way, jobs continue; opening the file again finds them.
"""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations of properties as values, hence no postponed evaluation here.

import sys
from typing import Any

import bpy

from ..core.errors import SnergError
from ..snerg_addon import activity

KEYS = {"Q": "QUIT", "O": "OPEN", "N": "NEW"}  # Blender's own shortcuts, all with Ctrl (Cmd on macOS)
TITLES = {"QUIT": "Quit Blender", "OPEN": "Open Another File", "NEW": "New File"}
_items: list[tuple[Any, Any]] = []


class SNERG_OT_quit(bpy.types.Operator):
    """Ask whether running SNeRG tasks continue, then close the file"""

    bl_idname = "snerg.quit"
    bl_label = "Close File"
    bl_options = {"INTERNAL"}

    jobs: bpy.props.EnumProperty(
        name="Running Tasks",
        items=[
            ("RUN", "Continue", "The tasks continue in the background; open the file again to see the results"),
            ("STOP", "Stop", "What is finished so far is kept"),
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
        """Whether jobs run; if not, Blender continues with the key's own operator."""
        return any(running.is_job for running in activity.current())

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Open the dialog."""
        title = TITLES[self.then]
        return set(context.window_manager.invoke_props_dialog(self, title=f"{title}?", confirm_text=title))

    def draw(self, _context: bpy.types.Context) -> None:
        """The running tasks, and the choice."""
        layout = self.layout
        for running in activity.current():
            layout.label(text=f"{running.label}: {running.task.text}", icon="SORTTIME" if running.outlives else "ERROR")
            if not running.is_job:
                layout.label(text="Stops in any case: it runs inside Blender")
            elif not running.outlives:
                layout.label(text="Stops with Blender: the file was never saved")
        layout.prop(self, "jobs", expand=True)

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Stop the tasks if chosen, then close the file. Blender itself asks about unsaved changes."""
        if self.jobs == "STOP":
            try:
                for running in activity.current():
                    running.task.cancel()
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
    """Add the shortcuts, which come before Blender's own. Background mode has none."""
    configuration = bpy.context.window_manager.keyconfigs.addon
    if configuration is None:
        return
    keymap, mac = configuration.keymaps.new(name="Window", space_type="EMPTY"), sys.platform == "darwin"
    for key, then in KEYS.items():
        item = keymap.keymap_items.new(SNERG_OT_quit.bl_idname, key, "PRESS", ctrl=not mac, oskey=mac)
        item.properties.then = then
        _items.append((keymap, item))


def remove_keys() -> None:
    """Remove the shortcuts."""
    while _items:
        keymap, item = _items.pop()
        keymap.keymap_items.remove(item)
