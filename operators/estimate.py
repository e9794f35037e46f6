"""What a bake will take, before it is begun."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import bpy

from ..core.jobs.runner import start_command
from ..core.jobs.task import Task
from ..snerg_addon.bridge import resolution
from ..snerg_addon.estimate_panel import told
from ..snerg_addon.project import Project
from .bake import baking_arguments
from .task_operator import TaskOperator


class SNERG_OT_estimate(TaskOperator, bpy.types.Operator):
    """Look at the field once, to say what a bake, its files and a preview will take; from then on at once, as the box is dragged"""

    bl_idname = "snerg.estimate"
    bl_label = "Estimate"
    bl_options = {"REGISTER"}
    step, label = "bake", "Looking at the field"
    needs = "field"

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """`estimate` of the command line, whose look at the field stays in the project for the panel."""
        with suppress(OSError):  # where it cannot be removed, the old look serves
            project.survey.unlink()  # the machine may have been busy when it was made
        width, height = resolution(context.scene)
        size = ["--width", str(width), "--height", str(height), "--survey", str(project.survey)]
        return start_command(["estimate", str(project.field), *size, *baking_arguments(context, project)])

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Say it; the panel goes on from what was found."""
        return "A bake takes " + ", ".join(told(result))
