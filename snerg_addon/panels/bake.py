"""The bake panel: resolution, estimate, and the baked scene."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

from .. import estimate_panel
from ..project import project_of
from .layout import LINE_WIDTH, Step, decibels, draw_box, joined, megabytes
from .versions import made_with


class BakeStep(Step):
    """The baked scene"""

    key, label, done = "bake", "Bake", "scene"

    def draw_header(self, header: bpy.types.UILayout) -> None:
        """Importing, in place of baking."""
        header.operator("snerg.import_scene", text="", icon="IMPORT", emboss=False)

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """The settings, the estimate, the buttons, and what the version in use is."""
        project = project_of(context.scene)
        column = layout.column(align=True)
        count = column.row(align=True)
        count.active = settings.voxel_size == 0
        count.prop(settings, "resolution")
        column.prop(settings, "voxel_size")
        column.prop(settings, "samples")
        refine = layout.row()
        refine.active = not settings.fit  # fitting moves the highlights too
        refine.prop(settings, "refine")
        layout.prop(settings, "fit")
        layout.prop(settings, "prune")
        estimate = estimate_panel.lines(context)
        draw_box(layout, *(part for line in estimate for part in textwrap.wrap(line, LINE_WIDTH)))
        layout.operator("snerg.estimate", icon="TIME", text="Estimate Again" if estimate else "Estimate")
        layout.operator("snerg.bake", icon="RENDER_STILL")
        layout.operator("snerg.import_scene", icon="IMPORT")
        if project.has("scene"):
            note = project.notes().get("scene", {})
            blocks = f"{note['blocks']} block{'' if note['blocks'] == 1 else 's'}" if isinstance(note.get("blocks"), int) else ""
            draw_box(layout, joined(decibels(note), blocks, megabytes(note)), *made_with(project, "scene"))
