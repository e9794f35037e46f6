"""Export the baked scene in the PNG layout of the reference implementation."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.jobs.runner import start_command
from ..core.jobs.task import Task
from ..snerg_addon.project import Project, remember
from .task_operator import TaskOperator


class SNERG_OT_export_scene(TaskOperator, bpy.types.Operator):
    """Export the baked scene as PNG files for the viewer of the published SNeRG code"""

    bl_idname = "snerg.export_scene"
    bl_label = "Export Scene"
    bl_options = {"REGISTER"}
    step, label = "export", "Exporting the scene"
    needs = "scene"

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """The command `export`."""
        return start_command(["export", str(project.scene), "--out", str(project.reference)])

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Record the export."""
        remember(project, "reference", project.reference, result)
        return f"Exported the scene to {project.reference}"
