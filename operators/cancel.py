"""Stop what is under way."""

from __future__ import annotations

import bpy

from ..snerg_addon import activity
from .job_runner import redraw


class SNERG_OT_cancel(bpy.types.Operator):
    """Stop what SNeRG is doing. Training keeps what it has learnt so far"""

    bl_idname = "snerg.cancel"
    bl_label = "Stop"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only while something runs."""
        return activity.current() is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The timer of the operator that runs sees it end."""
        busy = activity.current()
        if busy is not None:
            busy.work.cancel()
        redraw()
        return {"FINISHED"}
