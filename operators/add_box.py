"""Add a box round the selection."""

from __future__ import annotations

import bpy
import numpy as np

from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..snerg_addon.bridge import add_box
from ..snerg_addon.render_evaluation import evaluate_render
from ..snerg_addon.rendered import corners_of, owner_of, rendered_instances

MARGIN = 1.05  # size of the box over that of the objects, so that their surfaces lie inside


class SNERG_OT_add_box(bpy.types.Operator):
    """Add the box to bake. It fits the selected objects, or all objects that render if none is selected"""

    bl_idname = "snerg.add_box"
    bl_label = "Add Box"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether Blender is in Object Mode."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add the empty, select it, and make it the scene's box."""
        try:
            box = fitted_box(context)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        empty = add_box(box, context.scene)
        for thing in context.selected_objects:
            thing.select_set(False)
        empty.select_set(True)
        context.view_layer.objects.active = empty
        return {"FINISHED"}


def fitted_box(context: bpy.types.Context) -> Box:
    """A box round what renders of the selected objects, else round all that renders, else 2 units wide at the 3D cursor.

    Instances count, of collections and of geometry nodes; helpers that do not render do not. Raises SnergError.
    """

    def read(depsgraph: bpy.types.Depsgraph) -> list[tuple[bpy.types.Object, np.ndarray]]:
        return [(owner_of(instance), corners_of(instance)) for instance in rendered_instances(depsgraph)]

    found = evaluate_render(context.scene, read, layer=context.scene.snerg.view_layer)
    chosen = [corners for owner, corners in found if owner.select_get()] or [corners for _, corners in found]
    if not chosen:
        cursor = np.array(context.scene.cursor.location)
        return Box.axis_aligned(cursor - 1, cursor + 1)
    corners = np.concatenate(chosen)
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum((high - low) / 2 * MARGIN, 1e-3 * max(float((high - low).max()), 1e-3))
    return Box.axis_aligned((low + high) / 2 - half, (low + high) / 2 + half)
