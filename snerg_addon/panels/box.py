"""The box panel: which part of the world is baked."""

from __future__ import annotations

from typing import Any

import bpy

from .. import overlay
from ..bridge import box_of, size_text
from ..project import project_of
from .layout import Step, draw_box


class BoxStep(Step):
    """The part of the world that is baked"""

    key, label = "box", "Box"
    has_command = False

    def is_done(self, context: bpy.types.Context) -> bool:
        """Whether a box is chosen that still exists."""
        return box_of(context.scene) is not None

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """The box, a button to add one, and its size."""
        layout.prop(settings, "box", icon="EMPTY_AXIS")
        box = box_of(context.scene)
        layout.operator("snerg.add_box", icon="CUBE", text="Select Box" if box else "Add Box")
        if box:
            row = layout.row(align=True)
            row.operator("snerg.fit_box", text="Fit to Objects")
            if project_of(context.scene).has("field"):
                row.operator("snerg.fit_box_to_field", text="Fit to Field")
        if settings.box and box is None:
            draw_box(layout, f"{settings.box.name} was deleted; add a new box")
        if box:
            draw_box(layout, size_text(box, context.scene), "Drag the arrows on its faces, or", "move, rotate and scale it")
            layout.prop(settings, "show_voxels")
            if settings.show_voxels and (each := overlay.voxels_a_line(context.scene)) > 1:
                layout.label(text=f"A square stands for {each} x {each} voxels")
