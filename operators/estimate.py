"""Estimate a bake."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import bpy

from ..core.jobs.task import Task
from ..snerg_addon.bridge import resolution
from ..snerg_addon.estimate_panel import summary
from ..snerg_addon.project import Project
from ..snerg_addon.training_python import start_training
from .bake import baking_arguments
from .task_operator import TaskOperator


class SNERG_OT_estimate(TaskOperator, bpy.types.Operator):
    """Measure the field to estimate the time, memory and file size of a bake. Afterwards the estimate follows the box and the settings"""

    bl_idname = "snerg.estimate"
    bl_label = "Estimate"
    bl_options = {"REGISTER"}
    step, label = "bake", "Measuring the field"
    needs = "field"

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """The command `estimate`, whose field probe stays in the project for the panel."""
        with suppress(OSError):  # the old probe is used where it cannot be deleted
            project.survey.unlink()  # deleted, because the machine may have been busy when its times were measured
        width, height = resolution(context.scene)
        size = ["--width", str(width), "--height", str(height), "--survey", str(project.survey)]
        return start_training(["estimate", str(project.field), *size, *baking_arguments(context, project)])

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Report the estimate; from now on the panel updates it."""
        return "A bake takes " + ", ".join(summary(result))
