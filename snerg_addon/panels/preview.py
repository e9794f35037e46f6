"""The preview panel: the baked scene as an image in Blender."""

from __future__ import annotations

from typing import Any

import bpy

from ..bridge import PREVIEW
from .layout import Step, draw_box


class PreviewStep(Step):
    """The baked scene in Blender"""

    key, label = "preview", "Preview"

    def is_done(self, context: bpy.types.Context) -> bool:
        """Whether a preview was rendered."""
        return PREVIEW in bpy.data.images

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """The camera, the background, and the button."""
        layout.prop(context.scene, "camera")
        row = layout.row()
        row.active = not settings.transparent
        row.prop(settings, "background")
        layout.prop(settings, "transparent")
        layout.operator("snerg.preview", icon="IMAGE_DATA")
        if self.is_done(context):
            width, height = bpy.data.images[PREVIEW].size
            draw_box(layout, f"{width} x {height} px, image {PREVIEW!r}")
