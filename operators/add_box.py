"""Add a box round the selection."""

from __future__ import annotations

import bpy
import numpy as np

from ..core.geometry.box import Box
from ..snerg_addon.bridge import add_box
from ..snerg_addon.capture import evaluated
from ..snerg_addon.originals import SOLID

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
        empty = add_box(fitted_box(context), context.scene)
        for thing in context.selected_objects:
            thing.select_set(False)
        empty.select_set(True)
        context.view_layer.objects.active = empty
        return {"FINISHED"}


def fitted_box(context: bpy.types.Context) -> Box:
    """A box round the selected objects with volume or surface, else round all that render, else 2 units wide at the 3D cursor."""
    solid = [thing for thing in context.scene.objects if thing.type in SOLID and not thing.hide_render]
    chosen = [thing for thing in solid if thing.select_get()] or solid
    if not chosen:
        cursor = np.array(context.scene.cursor.location)
        return Box.axis_aligned(cursor - 1, cursor + 1)
    depsgraph = evaluated(context.scene)
    corners = np.concatenate([bound_corners(thing.evaluated_get(depsgraph)) for thing in chosen])
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum((high - low) / 2 * MARGIN, 1e-3 * max(float((high - low).max()), 1e-3))
    return Box.axis_aligned((low + high) / 2 - half, (low + high) / 2 + half)


def bound_corners(thing: bpy.types.Object) -> np.ndarray:
    """The corners [8, 3] of an evaluated object's bounding box, in world space."""
    matrix = np.array(thing.matrix_world, np.float64)
    return np.array([list(corner) for corner in thing.bound_box], np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
