"""Fit the box to what a trained field contains."""

from __future__ import annotations

import bpy

from ..core.errors import SnergError
from ..core.nerf.checkpoint import read_field
from ..core.nerf.content import Content, content_of
from ..snerg_addon.bridge import box_of, size_text
from ..snerg_addon.project import project_of
from .add_box import BoxOperator, axes_of_box, place
from .task_operator import MISSING


class SNERG_OT_fit_box_to_field(BoxOperator, bpy.types.Operator):
    """Fit the box to what the trained field contains, by its occupancy grid. The box keeps its rotation"""

    bl_idname = "snerg.fit_box_to_field"
    bl_label = "Fit Box to Field"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a field, and the box can be changed."""
        if not project_of(context.scene).has("field"):
            cls.poll_message_set(MISSING["field"])
            return False
        return super().poll(context)

    def act(self, context: bpy.types.Context) -> str:
        """Move and scale the empty; add it where there is none."""
        project, box = project_of(context.scene), box_of(context.scene)
        if not project.has("field"):
            raise SnergError(f"{MISSING['field']}.")
        content = content_of(read_field(project.field), axes_of_box(context.scene))
        before = "" if box is None else f" (before: {size_text(box, context.scene)})"
        box = place(content.box, context)
        return f"{box.name!r} now encloses the field's content, {size_text(box, context.scene)}{before}.{left_out(content)}"


def left_out(content: Content) -> str:
    """What is not in the box, a sentence; '' where all is."""
    if not content.groups:
        return ""
    one, share = content.groups == 1, content.stray / (content.stray + content.cells)
    return f" {'1 stray group' if one else f'{content.groups} stray groups'}, {share:.2%} of its cells, {'is' if one else 'are'} outside."
