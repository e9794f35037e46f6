"""Bake the field inside the box."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.io.files import write_bytes
from ..core.io.json_files import json_bytes
from ..core.jobs.task import Task
from ..snerg_addon.bridge import box_of
from ..snerg_addon.capture import evaluated
from ..snerg_addon.originals import originals_of
from ..snerg_addon.project import Project, remember
from ..snerg_addon.render_evaluation import evaluated_box
from ..snerg_addon.scene_object import show_scene
from ..snerg_addon.training_python import start_training
from .task_operator import TaskOperator, awaited


class SNERG_OT_bake(TaskOperator, bpy.types.Operator):
    """Bake the field inside the box into a sparse voxel grid that renders in real time, in the background"""

    bl_idname = "snerg.bake"
    bl_label = "Bake"
    bl_options = {"REGISTER"}
    step, label = "bake", "Baking"
    changes_file = True
    needs = "field"

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """The command `bake` with the current box; without a box, with the one that the field was trained in."""
        field, arguments = awaited(project, "field") or project.field, baking_arguments(context, project)
        out = project.new_version("scene")
        recorded = [part for part in arguments if part not in ("--box", str(project.box))]
        project.note_settings(out, ["--field", project.name_of(field), *recorded])
        return start_training(["bake", str(field), "--out", str(out), *arguments])

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Record the new version and put it in use. Warns where the box holds nothing."""
        about = result.get("about", {})
        quality = (about.get("fit") or about.get("refine", {})).get("psnr_after")
        before, folder = project.scene, project.version_made("scene", result["path"])
        remember(project, "scene", folder, {**result, "psnr": quality})
        made = show_scene(scene, project, folder, before)
        if warning := about.get("bake", {}).get("warning"):
            self.report({"WARNING"}, warning)
        sentence = f"Baked the scene{f' at {quality:.1f} dB' if quality else ''}; it is in {folder}"
        return sentence if made is None else sentence + hint(made, scene)


def hint(made: bpy.types.Object, scene: bpy.types.Scene) -> str:
    """What to do about the objects that a new SNeRG object stands among, a sentence; '' where there are none."""
    found = originals_of(made, scene, evaluated(scene))
    count = len(found.inside) + len(found.reaching) + len(found.linked)
    return f". {made.name!r} stands where what was baked still is; Hide Originals in its Object tab hides that" if count else ""


def baking_arguments(context: bpy.types.Context, project: Project) -> list[str]:
    """The command-line options for the panel's settings. Writes the current box to the project."""
    settings = context.scene.snerg
    arguments = ["--voxel-size", str(settings.voxel_size)] if settings.voxel_size else ["--resolution", str(settings.resolution)]
    arguments += ["--samples", str(settings.samples)]
    if box := box_to_bake(context, project):
        write_bytes(project.box, box)
        arguments += ["--box", str(project.box)]
    return [*arguments, *finishing_arguments(settings)]


def finishing_arguments(settings: Any) -> list[str]:
    """The command-line options for what is done after the bake."""
    chosen = ("--no-refine", not settings.refine), ("--fit", settings.fit)
    arguments = [name for name, given in chosen if given]
    return [*arguments, "--prune", f"{settings.prune:.4g}"] if settings.prune else arguments


def box_to_bake(context: bpy.types.Context, project: Project) -> bytes | None:
    """The current box as JSON; None where none is chosen.

    Also None for a forward-facing field, which is baked whole: its grid lies in NDC, where a box of the scene is no box.
    """
    box = box_of(context.scene)
    if box is None or project.notes().get("field", {}).get("ndc"):
        return None
    return json_bytes(evaluated_box(context.scene, box).to_json())
