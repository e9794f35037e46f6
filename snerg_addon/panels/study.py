"""The study panel: measurements of quality against time and size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from .. import pictures
from ..bridge import STUDY
from ..project import project_of
from .layout import Step, draw_box

PLOT_SCALE = 10.0  # of the plot of the Pareto front, in rows of the panel


class StudyStep(Step):
    """Quality against time and file size"""

    key, label = "study", "Study"

    def is_done(self, context: bpy.types.Context) -> bool:
        """Whether there is a report."""
        return "study" in project_of(context.scene).notes()

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """How long to measure, the button, and the report."""
        column = layout.column(align=True)
        column.prop(settings, "study_minutes")
        column.prop(settings, "target_db")
        layout.operator("snerg.study", icon="GRAPH")
        note = project_of(context.scene).notes().get("study", {})
        if note:
            remaining = f"{note['left_out']} not measured yet" if note.get("left_out") else ""
            draw_box(layout, f"{note.get('configurations', 0)} configurations measured", remaining)
            report = Path(str(note.get("report", "")))
            if icon := pictures.icon_of_file(report.parent / "plots" / "error-and-time.png"):
                layout.template_icon(icon, scale=PLOT_SCALE)
            layout.operator("wm.path_open", text="Open Report", icon="URL").filepath = str(report)
        if STUDY in bpy.data.images:
            draw_box(layout, f"Comparison: image {STUDY!r}")
