"""The preview panel: the baked scene as an image in Blender."""

from __future__ import annotations

from typing import Any

import bpy

from ..bridge import PREVIEW, image_editor
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
            image = bpy.data.images[PREVIEW]
            draw_box(layout, f"{image.size[0]} x {image.size[1]} px, image {PREVIEW!r}", where(context, image))
            if image_editor(image) is None:
                layout.operator("snerg.show_preview", icon="WINDOW")


def where(context: bpy.types.Context, image: bpy.types.Image) -> str:
    """Where an image can be seen."""
    found = image_editor(image)
    if found is None:
        return "In this file; no editor shows it now"
    return f"In the image editor of {'this' if found[0] == context.window else 'another'} window"
