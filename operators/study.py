"""Measure quality against time and size."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import bpy

from ..core.io.files import write_bytes
from ..core.jobs.task import Task
from ..snerg_addon.bridge import STUDY
from ..snerg_addon.project import Project, remember
from ..snerg_addon.training_python import start_training
from .bake import box_to_bake
from .task_operator import TaskOperator


class SNERG_OT_study(TaskOperator, bpy.types.Operator):
    """Measure how resolution, samples, image format and other settings affect quality, time and file size, and write a report"""

    bl_idname = "snerg.study"
    bl_label = "Study"
    bl_options = {"REGISTER"}
    step, label = "study", "Studying"
    changes_file = True
    needs = "field"

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """The command `study`, with the panel's resolution in the baseline configuration.

        Each field, box and resolution has a folder of its own, so that a study only continues measurements of the same.
        """
        return start_training(study_arguments(context, project))

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Load the contact sheet as an image, and record where the report is."""
        folder = Path(result["out"])
        old = bpy.data.images.get(STUDY)
        if old is not None:
            bpy.data.images.remove(old)
        image = bpy.data.images.load(str(folder / "contact.png"))
        image.name, image.use_fake_user = STUDY, True
        remember(project, "study", folder, result)
        return f"Measured {result['configurations']} configurations; the report is {result['report']}"


def study_arguments(context: bpy.types.Context, project: Project) -> list[str]:
    """The command line of the study. Writes the current box beside the study."""
    folder, box = study_folder(context, project)
    arguments = ["study", str(project.field), *study_options(context), *(["--box", str(box)] if box else [])]
    return [*arguments, *target_options(context), "--out", str(folder)]


def study_folder(context: bpy.types.Context, project: Project) -> tuple[Path, Path | None]:
    """The folder of the study of the project's field with the panel's settings, and the file of its box; None for the whole domain."""
    where = f"{context.scene.snerg.resolution}-{(project.field / 'field.npz').stat().st_mtime_ns:x}"
    box = box_to_bake(context, project)
    if box is None:
        return project.studies / where, None
    where += f"-{zlib.crc32(box):08x}"
    path = project.studies / f"{where}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, box)
    return project.studies / where, path


def study_options(context: bpy.types.Context) -> list[str]:
    """The command-line options for the panel's settings."""
    settings = context.scene.snerg
    return ["--minutes", f"{settings.study_minutes:g}", "--resolution", str(settings.resolution)]


def target_options(context: bpy.types.Context) -> list[str]:
    """The command-line options for the panel's target; [] where there is none."""
    target = context.scene.snerg.target_db
    return ["--target-db", f"{target:g}"] if target else []
