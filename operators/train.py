"""Dataset to field."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.jobs.runner import start_verb
from ..snerg_addon.activity import Work
from ..snerg_addon.project import Project, remember
from .job_runner import LongVerb


class SNERG_OT_train(LongVerb, bpy.types.Operator):
    """Train a field on the dataset, in a process of its own. Continues where an earlier training stopped"""

    bl_idname = "snerg.train"
    bl_label = "Train Field"
    bl_options = {"REGISTER"}
    step, label = "field", "Training"
    needs, queues = "dataset", True

    def start(self, context: bpy.types.Context, project: Project) -> Work:
        """`train` of the command line."""
        arguments = training_arguments(context.scene, project)
        project.note("training", {"arguments": arguments})
        return start_verb(arguments)

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Note what it came to, and why it went as it did."""
        remember(project, "field", project.field, result, decisions=result.get("decisions", []))
        quality = f" at {result['psnr']:.1f} dB" if isinstance(result.get("psnr"), float) else ""
        return f"Trained the field{quality}; it is in {project.field}"


def training_arguments(scene: bpy.types.Scene, project: Project) -> list[str]:
    """What to start: an unfinished training goes on only with the same."""
    settings = scene.snerg
    background = settings.train_background
    if background == "colour":
        background = "#{:02x}{:02x}{:02x}".format(*(round(255 * value) for value in settings.train_colour))
    return [
        *("train", str(project.dataset), "--out", str(project.field), "--preset", settings.preset, "--seed", str(settings.seed)),
        *(("--steps", str(settings.steps)) if settings.steps else ("--minutes", f"{settings.minutes:g}")),
        *("--view-dependence", settings.view_dependence, "--background", background),
        *("--holdout", str(settings.test_every), "--downscale", str(settings.downscale)),
    ]
