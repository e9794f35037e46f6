"""Scene to dataset."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation of `goes_on` as a value, hence no postponed evaluation here.

from typing import Any

import bpy

from ..core.artifact import is_dataset
from ..core.data.rig import RigSettings, rig_cameras
from ..core.errors import SnergError
from ..core.io.files import check_replaceable
from ..core.jobs.task import StepTask, Task
from ..snerg_addon.bridge import box_from_blender, box_of, resolution
from ..snerg_addon.capture import CaptureSettings, Shot, core_cameras, evaluated, render_steps, unfinished
from ..snerg_addon.owner import shown
from ..snerg_addon.project import Project, project_of, remember
from ..snerg_addon.render_job import render_job
from .task_operator import TaskOperator


class SNERG_OT_render_dataset(TaskOperator, bpy.types.Operator):
    """Render the scene from many cameras on a transparent film, as photographs to train a field on"""

    bl_idname = "snerg.render_dataset"
    bl_label = "Render Dataset"
    bl_options = {"REGISTER"}
    step, label = "dataset", "Rendering the dataset"

    goes_on: bpy.props.BoolProperty(
        name="Go On",
        description="Keep the views of a rendering that was stopped, where its cameras and render settings were the same. "
        "What was changed in the scene since shows only in the views that are still missing",
        default=True,
        options={"SKIP_SAVE"},
    )

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """From a copy of the file, in a process of its own; in a script's own process, which has no window to keep free."""
        scene, settings = context.scene, context.scene.snerg
        box = box_from_blender(box_of(scene), evaluated(scene)) if box_of(scene) else None
        shots = chosen_shots(context)
        core_cameras(scene, shots)  # refuses at once what could not be rendered later
        for folder in (project.own_dataset, unfinished(project.own_dataset)):
            check_replaceable(folder)
        if bpy.app.background:
            return StepTask(render_steps(scene, shots, project.own_dataset, CaptureSettings(settings.test_every), box, self.goes_on))
        chosen = rig_settings(context) if settings.cameras == "RIG" else shots
        return render_job(scene, chosen, project.own_dataset, settings.test_every, box, self.goes_on)

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """The new dataset becomes the one to train on."""
        scene.snerg.dataset = ""
        remember(project, "dataset", project.own_dataset, result)
        kept = f"; {result['kept']} of them are of the run before, as the scene was then" if result.get("kept") else ""
        return f"Rendered {result['train']} views to train on and {result['test']} to test on into {project.own_dataset}{kept}"


class SNERG_OT_use_views(bpy.types.Operator):
    """Train on the views of an unfinished rendering that are there"""

    bl_idname = "snerg.use_views"
    bl_label = "Use These Views"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """They are a dataset already."""
        part = unfinished(project_of(context.scene).own_dataset)
        if not is_dataset(part):
            self.report({"ERROR"}, "No view has been rendered yet; render the dataset first.")
            return {"CANCELLED"}
        context.scene.snerg.dataset = shown(part)
        return {"FINISHED"}


def chosen_shots(context: bpy.types.Context) -> list[Shot]:
    """What the settings say to render from, by name. Raises SnergError when that is nothing."""
    settings = context.scene.snerg
    if settings.cameras == "RIG":
        box = box_from_blender(box_of(context.scene), evaluated(context.scene))
        return list(rig_cameras(box, rig_settings(context), *resolution(context.scene)))
    return scene_cameras(context, settings.cameras)


def rig_settings(context: bpy.types.Context) -> RigSettings:
    """The rig as the panel says."""
    settings = context.scene.snerg
    return RigSettings(settings.rig_count, settings.rig_shape == "HEMISPHERE", settings.rig_angle, settings.rig_distance)


def scene_cameras(context: bpy.types.Context, which: str) -> list[Shot]:
    """'ALL', 'SELECTED' or 'ACTIVE' cameras of the scene, by name. Raises SnergError when there are none."""
    if which == "ACTIVE":
        cameras = [context.scene.camera] if context.scene.camera else []
    else:
        cameras = [thing for thing in context.scene.objects if thing.type == "CAMERA" and (which == "ALL" or thing.select_get())]
    if not cameras:
        hint = {"ACTIVE": "no active camera; make one active", "SELECTED": "no camera selected; select some, or choose All or Rig"}
        raise SnergError(f"The scene has {hint.get(which, 'no camera; add some, or choose Rig')}.")
    return sorted(cameras, key=lambda camera: camera.name)
