"""The box panel: which part of the world is baked."""

from __future__ import annotations

from typing import Any

import bpy

from ..bridge import box_of
from .layout import StepPanel, draw_box


class SNERG_PT_box(StepPanel, bpy.types.Panel):
    """The part of the world that is baked"""

    bl_label = "Box"
    bl_idname = "SNERG_PT_box"

    def is_done(self, context: bpy.types.Context) -> bool:
        """Whether a box is chosen that still exists."""
        return box_of(context.scene) is not None

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """The box, a button to add one, and its size."""
        layout.prop(settings, "box", icon="EMPTY_AXIS")
        layout.operator("snerg.add_box", icon="CUBE")
        box = box_of(context.scene)
        if settings.box and box is None:
            draw_box(layout, f"{settings.box.name} was deleted; add a new box")
        if box:
            size = [2 * abs(s) * box.empty_display_size for s in box.matrix_world.to_scale()]
            unit = context.scene.unit_settings
            texts = [bpy.utils.units.to_string(unit.system, "LENGTH", s * unit.scale_length, precision=3) for s in size]
            draw_box(layout, " x ".join(texts), "Move, rotate and scale it in the viewport")
