"""Hide and show the objects that a baked scene was made of."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations as values, hence no postponed evaluation here.

import bpy

from ..snerg_addon.capture import evaluated
from ..snerg_addon.originals import hidden_for, hide, originals_of, show
from .scene_object_operator import SceneObjectOperator


class SNERG_OT_hide_originals(SceneObjectOperator, bpy.types.Operator):
    """Hide what stands in the box that was baked, in the viewport and in renders, so that the baked scene alone is seen there"""

    bl_idname = "snerg.hide_originals"
    bl_label = "Hide Originals"
    bl_options = {"REGISTER", "UNDO"}

    reaching: bpy.props.BoolProperty(
        name="Partly in the Box",
        description="Hide objects that reach out of the box too; the baked scene shows only the part of them that is within it",
        default=False,
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Hide them, and say which."""
        found = originals_of(context.object, context.scene, evaluated(context.scene))
        chosen = found.inside + (found.reaching if self.reaching else [])
        if not chosen and not found.reaching and not found.linked:
            self.report({"WARNING"}, "Nothing that renders stands in the box that was baked.")
            return {"CANCELLED"}
        hide(chosen, context.view_layer)
        sentences = [f"Hidden in viewport and render: {names(chosen)}."] if chosen else []
        if found.reaching and not self.reaching:
            sentences.append(f"Not hidden, because they reach out of the box: {names(found.reaching)}.")
        if found.linked:
            sentences.append(f"Not hidden, because they are linked from another file: {names(found.linked)}.")
        self.report({"INFO" if chosen else "WARNING"}, " ".join(sentences))
        return {"FINISHED"}


class SNERG_OT_show_originals(SceneObjectOperator, bpy.types.Operator):
    """Show again what Hide Originals has hidden in the box that was baked"""

    bl_idname = "snerg.show_originals"
    bl_label = "Show Originals"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Show them, and say which."""
        chosen = hidden_for(context.object, context.scene, evaluated(context.scene))
        if not chosen:
            self.report({"WARNING"}, "Hide Originals has hidden nothing in the box that was baked.")
            return {"CANCELLED"}
        show(chosen, context.view_layer)
        self.report({"INFO"}, f"Shown again: {names(chosen)}.")
        return {"FINISHED"}


def names(things: list[bpy.types.Object]) -> str:
    """Their names, in a sentence."""
    return ", ".join(sorted(thing.name for thing in things))
