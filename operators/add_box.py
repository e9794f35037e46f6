"""Add the box, and fit it to objects."""

from __future__ import annotations

import bpy
import numpy as np

from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..snerg_addon.bridge import add_box, box_from_blender, box_of, set_box, size_text
from ..snerg_addon.render_evaluation import evaluate_render
from ..snerg_addon.rendered import corners_of, owner_of, rendered_instances

MARGIN = 1.05  # size of the box over that of the objects, so that their surfaces lie inside


class BoxOperator:
    """Mixed into an operator that adds the box, or changes it in one undo step."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether Blender is in Object Mode."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")  # type: ignore[attr-defined]
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do the work, and say what was done."""
        try:
            sentence = self.act(context)
        except SnergError as error:
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return {"CANCELLED"}
        self.report({"INFO"}, sentence)  # type: ignore[attr-defined]
        return {"FINISHED"}

    def act(self, context: bpy.types.Context) -> str:
        """Change the box. Returns a sentence that says how. Raises SnergError."""
        raise NotImplementedError


class SNERG_OT_add_box(BoxOperator, bpy.types.Operator):
    """Add the box to bake, round the selected objects, or round all objects that render if none is selected. Where the scene has its box,
    select that one"""

    bl_idname = "snerg.add_box"
    bl_label = "Add Box"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: bpy.types.Context) -> str:
        """Add the empty unless there is one, select it, and make it the scene's box."""
        box = box_of(context.scene)
        if box is not None:
            select(box, context)
            return f"The scene has a box, {box.name!r}; it is selected now. Fit to Objects fits it anew."
        empty = add_box(fitted_box(context), context.scene)
        select(empty, context)
        return f"Added {empty.name!r}, {size_text(empty, context.scene)}."


class SNERG_OT_fit_box(BoxOperator, bpy.types.Operator):
    """Fit the box to the selected objects, or to all objects that render if none is selected. The box keeps its rotation"""

    bl_idname = "snerg.fit_box"
    bl_label = "Fit Box to Objects"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: bpy.types.Context) -> str:
        """Move and scale the empty; add it where there is none."""
        box = place(fitted_box(context, axes_of_box(context.scene)), context)
        return f"{box.name!r} now encloses what renders of the objects, {size_text(box, context.scene)}."


def axes_of_box(scene: bpy.types.Scene) -> np.ndarray | None:
    """The axes that a fitted box has, as the columns of a rotation [3, 3]: those of the scene's box; None where there is none.

    Raises SnergError for a box that cannot be changed, and for one without a volume or sheared.
    """
    box = box_of(scene)
    if box is None:
        return None
    if box.library is not None:
        raise SnergError(f"The box {box.name!r} is linked from another file; choose one of this file under Box.")
    return np.asarray(box_from_blender(box).box_to_world[:3, :3])


def place(fitted: Box, context: bpy.types.Context) -> bpy.types.Object:
    """Give the scene's box the place of `fitted`; add it, selected, where there is none."""
    box = box_of(context.scene)
    if box is None:
        box = add_box(fitted, context.scene)
        select(box, context)
    else:
        set_box(box, fitted)
    return box


def select(thing: bpy.types.Object, context: bpy.types.Context) -> None:
    """Make an object the only selected and the active one, and show it where it is hidden.

    Raises SnergError where this view layer does not hold it.
    """
    try:
        thing.hide_set(False)
        thing.select_set(True)
    except RuntimeError as error:
        raise SnergError(f"The box {thing.name!r} is in a collection that the view layer excludes; include it in the Outliner.") from error
    for other in context.selected_objects:
        other.select_set(other == thing)
    if thing.library is None:
        thing.hide_viewport = False
    context.view_layer.objects.active = thing


def fitted_box(context: bpy.types.Context, axes: np.ndarray | None = None) -> Box:
    """A box round what renders of the selected objects, else round all that renders, else 2 units wide at the 3D cursor.

    axes: its axes as the columns of a rotation [3, 3]; the world's by default. Instances count, of collections and of geometry nodes;
    helpers that do not render do not. Raises SnergError.
    """

    def read(depsgraph: bpy.types.Depsgraph) -> list[tuple[bpy.types.Object, np.ndarray]]:
        return [(owner_of(instance), corners_of(instance)) for instance in rendered_instances(depsgraph)]

    found = evaluate_render(context.scene, read, layer=context.scene.snerg.view_layer)
    chosen = [corners for owner, corners in found if owner.select_get()] or [corners for _, corners in found]
    rotation = np.eye(3) if axes is None else axes
    if not chosen:
        cursor = np.array(context.scene.cursor.location)
        return Box.axis_aligned(cursor - 1, cursor + 1)
    corners = np.concatenate(chosen) @ rotation
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum((high - low) / 2 * MARGIN, 1e-3 * max(float((high - low).max()), 1e-3))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, rotation @ ((low + high) / 2)
    return Box(pose, 2 * half)
