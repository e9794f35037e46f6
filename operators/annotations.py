"""Add and remove the annotations that an exported page shows."""

from __future__ import annotations

import bpy

from ..core.errors import SnergError
from ..snerg_addon.annotation_objects import add_note, annotate


class SNERG_OT_add_annotation(bpy.types.Operator):
    """Make the selected empties annotations, with their names as texts. Without a selected empty, add one at the 3D cursor"""

    bl_idname = "snerg.add_annotation"
    bl_label = "Add Annotation"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether Blender is in Object Mode."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Say what was annotated."""
        empties = [thing for thing in context.selected_objects if thing.type == "EMPTY"]
        try:
            if empties:
                sentence = f"{annotate(empties)} of {len(empties)} selected empties are new annotations."
            else:
                sentence = f"Added the annotation {add_note(context).name!r} at the 3D cursor."
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, sentence)
        return {"FINISHED"}


class SNERG_OT_remove_annotation(bpy.types.Operator):
    """Take the text from an empty, which stays in the scene"""

    bl_idname = "snerg.remove_annotation"
    bl_label = "Remove Annotation"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    name: bpy.props.StringProperty(name="Empty", options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Take the text of the empty of that name."""
        thing = context.scene.objects.get(self.name)
        if thing is None:
            self.report({"ERROR"}, f"The scene has no object {self.name!r}.")
            return {"CANCELLED"}
        if thing.library is not None:
            self.report({"ERROR"}, f"{self.name!r} is linked from another file; remove its text there.")
            return {"CANCELLED"}
        thing.snerg_note.text = ""
        return {"FINISHED"}
