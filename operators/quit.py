"""Closing Blender while jobs run. No add-on can hold Blender back, but the key for it can ask first.

Closed any other way, jobs run on; opening the file again finds them.
"""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation of `jobs` as a value, hence no postponed evaluation here.

import sys
from typing import Any

import bpy

from ..core.errors import SnergError
from ..snerg_addon import activity

_keys: list[tuple[Any, Any]] = []


class SNERG_OT_quit(bpy.types.Operator):
    """Quit Blender, asking first what becomes of the work that SNeRG has under way"""

    bl_idname = "snerg.quit"
    bl_label = "Quit"
    bl_options = {"INTERNAL"}

    jobs: bpy.props.EnumProperty(
        name="Work Under Way",
        items=[
            ("RUN", "Let It Run On", "It goes on without Blender; opening the file again shows how it went"),
            ("STOP", "Stop It", "What was finished before is kept"),
        ],
        default="RUN",
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Ask where there is something to ask."""
        if not any(begun.is_job for begun in activity.current()):
            return self.execute(context)
        return set(context.window_manager.invoke_props_dialog(self, title="Quit Blender?", confirm_text="Quit"))

    def draw(self, _context: bpy.types.Context) -> None:
        """What is under way, and the choice."""
        layout = self.layout
        for begun in activity.current():
            layout.label(text=f"{begun.label}: {begun.work.message}", icon="SORTTIME" if begun.outlives else "ERROR")
            if not begun.outlives:
                layout.label(text="It ends in any case: " + ("the file was never saved" if begun.is_job else "Blender does it itself"))
        layout.prop(self, "jobs", expand=True)

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Blender asks about unsaved changes itself."""
        if self.jobs == "STOP":
            try:
                for begun in activity.current():
                    begun.work.cancel()
            except SnergError as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
        return set(bpy.ops.wm.quit_blender("INVOKE_DEFAULT"))


def add_keys() -> None:
    """Take Blender's own key for Quit. There is no keyboard, and no configuration of keys, in background mode."""
    keys = bpy.context.window_manager.keyconfigs.addon
    if keys is not None:
        keymap = keys.keymaps.new(name="Window", space_type="EMPTY")
        item = keymap.keymap_items.new(SNERG_OT_quit.bl_idname, "Q", "PRESS", ctrl=sys.platform != "darwin", oskey=sys.platform == "darwin")
        _keys.append((keymap, item))


def remove_keys() -> None:
    """Give it back."""
    while _keys:
        keymap, item = _keys.pop()
        keymap.keymap_items.remove(item)
