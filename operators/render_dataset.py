"""Scene to dataset."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.capture.rig import RigSettings, rig_cameras
from ..core.errors import SnergError
from ..core.files import check_replaceable
from ..snerg_addon.activity import Steps, Work
from ..snerg_addon.bridge import box_from_blender, resolution
from ..snerg_addon.capture import CaptureSettings, Shot, core_cameras, evaluated, render_steps
from ..snerg_addon.project import Project, remember
from .job_runner import LongVerb


class SNERG_OT_render_dataset(LongVerb, bpy.types.Operator):
    """Render the scene from many cameras on a transparent film, as photographs to train a field on"""

    bl_idname = "snerg.render_dataset"
    bl_label = "Render Dataset"
    bl_options = {"REGISTER"}
    step, label = "dataset", "Rendering the dataset"

    def start(self, context: bpy.types.Context, project: Project) -> Work:
        """Every view is one step, between which the window lives on."""
        scene, settings = context.scene, context.scene.snerg
        box = box_from_blender(settings.box, evaluated(scene)) if settings.box else None
        shots = chosen_shots(context)
        core_cameras(scene, shots)  # refuses at once what could not be rendered later
        check_replaceable(project.own_dataset)
        return Steps(render_steps(scene, shots, project.own_dataset, CaptureSettings(settings.test_every), box))

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """The new dataset becomes the one to train on."""
        scene.snerg.dataset = ""
        remember(project, "dataset", project.own_dataset, result)
        return f"Rendered {result['train']} views to train on and {result['test']} to test on into {project.own_dataset}"


def chosen_shots(context: bpy.types.Context) -> list[Shot]:
    """What the settings say to render from, by name. Raises SnergError when that is nothing."""
    settings = context.scene.snerg
    if settings.cameras == "RIG":
        box = box_from_blender(settings.box, evaluated(context.scene))
        rig = RigSettings(settings.rig_count, settings.rig_shape == "HEMISPHERE", settings.rig_angle, settings.rig_distance)
        return list(rig_cameras(box, rig, *resolution(context.scene)))
    return scene_cameras(context, settings.cameras)


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
