"""Stop what is under way."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation of `work` as a value, hence no postponed evaluation here.

import bpy

from ..core.errors import SnergError
from ..snerg_addon import activity
from .task_operator import redraw


class SNERG_OT_cancel(bpy.types.Operator):
    """Stop what SNeRG is doing. Training keeps what it has learnt so far"""

    bl_idname = "snerg.cancel"
    bl_label = "Stop"
    bl_options = {"INTERNAL"}

    work: bpy.props.StringProperty(name="Work", description="What to stop; everything when empty", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """Names what the button stops."""
        label = next((begun.label for begun in activity.current() if begun.key == properties.work), "what SNeRG is doing")
        return f"Stop: {label}. What was finished before is kept"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only while something runs."""
        return bool(activity.current())

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The timer sees it end."""
        try:
            for begun in activity.current():
                if self.work in ("", begun.key):
                    begun.task.cancel()
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        redraw()
        return {"FINISHED"}
