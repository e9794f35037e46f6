"""Stop running tasks."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation of `work` as a value, hence no postponed evaluation here.

import bpy

from ..core.errors import SnergError
from ..snerg_addon import activity
from .task_operator import redraw


class SNERG_OT_cancel(bpy.types.Operator):
    """Stop the running tasks. Training keeps its progress"""

    bl_idname = "snerg.cancel"
    bl_label = "Stop"
    bl_options = {"INTERNAL"}

    work: bpy.props.StringProperty(name="Task", description="The task to stop. Empty: all", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """The tooltip, which names the task."""
        label = next((running.label for running in activity.current() if running.key == properties.work), "all running tasks")
        return f"Stop: {label}. What is finished so far is kept"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a task runs."""
        return bool(activity.current())

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Ask the tasks to stop; the timer (watch.py) notices when they have ended."""
        try:
            for running in activity.current():
                if self.work in ("", running.key):
                    running.task.cancel()
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        redraw()
        return {"FINISHED"}
