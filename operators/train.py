"""Train a field on the dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..core.jobs.task import Task
from ..snerg_addon.curve import curve_of
from ..snerg_addon.dataset_notes import note_dataset
from ..snerg_addon.project import Project, remember
from ..snerg_addon.training_python import start_training
from .task_operator import TaskOperator


class SNERG_OT_train(TaskOperator, bpy.types.Operator):
    """Train a radiance field on the dataset, in the background. Continues an unfinished training with the same settings"""

    bl_idname = "snerg.train"
    bl_label = "Train Field"
    bl_options = {"REGISTER"}
    step, label = "field", "Training"
    needs, queues = "dataset", True

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """The command `train`."""
        scene, settings = context.scene, context.scene.snerg
        out = unfinished(scene, project) or project.new_version("field")
        arguments = training_arguments(scene, project, out)
        project.note("training", {"arguments": training_arguments(scene, project), "out": project.key(out)})
        note_dataset(project, project.dataset, {})
        project.note_settings(out, arguments[arguments.index("--preset") :])
        shown = settings.show_training and not bpy.app.background
        return start_training([*arguments, "--preview"] if shown else arguments)

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Record the new version with the decisions of the training, and put it in use."""
        folder = project.version_made("field", result["field"])
        remember(project, "field", folder, result, decisions=result.get("decisions", []))
        project.note_remarks(Path(str(result.get("dataset", project.dataset))), result.get("remarks", []))
        quality = f" at {result['psnr']:.1f} dB" if isinstance(result.get("psnr"), float) else ""
        return f"Trained the field{quality}; it is in {folder}"


def unfinished(scene: bpy.types.Scene, project: Project) -> Path | None:
    """The version that training would continue: the one started last, if it was stopped and had the same settings; else None."""
    last = project.notes().get("training", {})
    out = project.folder / str(last.get("out", "field"))
    curve = curve_of(out)
    if curve is None or curve.fraction >= 1 or not (out / "field.npz").is_file() or project.note_of(out):
        return None
    return out if last.get("arguments") == training_arguments(scene, project) else None


def training_arguments(scene: bpy.types.Scene, project: Project, out: Path | None = None) -> list[str]:
    """The command line of the training. out: its version; None for arguments without it, to compare two trainings."""
    settings = scene.snerg
    background = settings.train_background
    if background == "colour":
        background = "#{:02x}{:02x}{:02x}".format(*(round(255 * value) for value in settings.train_colour))
    return [
        *("train", *((project.key(project.dataset),) if out is None else (str(project.dataset), "--out", str(out)))),
        *("--preset", settings.preset, "--seed", str(settings.seed)),
        *(("--steps", str(settings.steps)) if settings.steps else ("--minutes", f"{settings.minutes:g}")),
        *("--view-dependence", settings.view_dependence, "--background", background),
        *("--holdout", str(settings.test_every), "--downscale", str(settings.downscale)),
    ]
