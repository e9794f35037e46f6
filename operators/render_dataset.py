"""Render a dataset from the scene."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation of `goes_on` as a value, hence no postponed evaluation here.

from typing import Any

import bpy

from ..core.artifact import is_dataset
from ..core.data.rig import rig_cameras
from ..core.errors import SnergError
from ..core.io.files import check_replaceable
from ..core.jobs.task import StepTask, Task
from ..snerg_addon.bridge import box_from_blender, box_of, resolution, rig_settings
from ..snerg_addon.capture import CaptureSettings, Shot, core_cameras, evaluated, render_steps, unfinished
from ..snerg_addon.owner import blend_path
from ..snerg_addon.project import Project, project_of, remember
from ..snerg_addon.render_job import render_job
from .task_operator import TaskOperator


class SNERG_OT_render_dataset(TaskOperator, bpy.types.Operator):
    """Render the scene from many cameras with a transparent background, as images to train a field on"""

    bl_idname = "snerg.render_dataset"
    bl_label = "Render Dataset"
    bl_options = {"REGISTER"}
    step, label = "dataset", "Rendering the dataset"
    changes_file = True

    goes_on: bpy.props.BoolProperty(
        name="Resume",
        description="Keep the views of an unfinished rendering with the same cameras and render settings. "
        "Changes to the scene since then show only in the views that are still missing",
        default=True,
        options={"SKIP_SAVE"},
    )

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """A job that renders a copy of the file; in background mode, which has no window to keep free, a task in this process."""
        scene, settings = context.scene, context.scene.snerg
        box = box_from_blender(box_of(scene), evaluated(scene)) if box_of(scene) else None
        shots = chosen_shots(context)
        core_cameras(scene, shots)  # raises now where a camera could not be rendered later
        for folder in (project.own_dataset, unfinished(project.own_dataset)):
            check_replaceable(folder)
        if bpy.app.background:
            return StepTask(render_steps(scene, shots, project.own_dataset, CaptureSettings(settings.test_every), box, self.goes_on))
        chosen = rig_settings(context.scene) if settings.cameras == "RIG" else shots
        return render_job(scene, chosen, project.own_dataset, settings.test_every, box, self.goes_on)

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Record the dataset, and make it the one to train on."""
        scene.snerg.dataset = ""
        remember(project, "dataset", project.own_dataset, result)
        kept = f"; {result['kept']} of them were kept from the run before and show the scene as it was then" if result.get("kept") else ""
        return f"Rendered {result['train']} views to train on and {result['test']} to test on into {project.own_dataset}{kept}"


class SNERG_OT_use_views(bpy.types.Operator):
    """Train on the views that are rendered so far"""

    bl_idname = "snerg.use_views"
    bl_label = "Use These Views"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Make the unfinished dataset the one to train on."""
        part = unfinished(project_of(context.scene).own_dataset)
        if not is_dataset(part):
            self.report({"ERROR"}, "No view has been rendered yet; render the dataset first.")
            return {"CANCELLED"}
        context.scene.snerg.dataset = blend_path(part)
        return {"FINISHED"}


def chosen_shots(context: bpy.types.Context) -> list[Shot]:
    """The cameras that the settings choose, sorted by name. Raises SnergError where there are none."""
    settings = context.scene.snerg
    if settings.cameras == "RIG":
        box = box_from_blender(box_of(context.scene), evaluated(context.scene))
        return list(rig_cameras(box, rig_settings(context.scene), *resolution(context.scene)))
    return scene_cameras(context, settings.cameras)


def scene_cameras(context: bpy.types.Context, which: str) -> list[Shot]:
    """The cameras of the scene, sorted by name. which: 'ALL', 'SELECTED' or 'ACTIVE'. Raises SnergError where there are none."""
    if which == "ACTIVE":
        cameras = [context.scene.camera] if context.scene.camera else []
    else:
        cameras = [thing for thing in context.scene.objects if thing.type == "CAMERA" and (which == "ALL" or thing.select_get())]
    if not cameras:
        hint = {"ACTIVE": "no active camera; make one active", "SELECTED": "no camera selected; select some, or choose All or Rig"}
        raise SnergError(f"The scene has {hint.get(which, 'no camera; add some, or choose Rig')}.")
    return sorted(cameras, key=lambda camera: camera.name)
