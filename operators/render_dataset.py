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
from ..snerg_addon.bridge import box_of, resolution, rig_settings
from ..snerg_addon.capture import core_cameras, render_steps, shot_splits, unfinished
from ..snerg_addon.capture_scene import CaptureSettings
from ..snerg_addon.owner import blend_path
from ..snerg_addon.project import Project, project_of, remember
from ..snerg_addon.render_evaluation import evaluated_box
from ..snerg_addon.render_job import render_job
from ..snerg_addon.render_passes import ENGINES, PASSES, check_passes
from ..snerg_addon.shots import Moment, Shot, active_at
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
        box = evaluated_box(scene, box_of(scene)) if box_of(scene) else None
        shots, capture = chosen_shots(context), capture_settings(context)
        core_cameras(scene, shots[:1] if settings.over_frames else shots)  # raises now where a camera could not be rendered later
        shot_splits(shots, capture)
        for folder in (project.own_dataset, unfinished(project.own_dataset)):
            check_replaceable(folder)
        check_passes(capture.passes)
        if bpy.app.background:
            return StepTask(render_steps(scene, shots, project.own_dataset, capture, box, self.goes_on))
        chosen = rig_settings(scene) if settings.cameras == "RIG" else shots
        return render_job(scene, chosen, project.own_dataset, capture, box, self.goes_on)

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Record the dataset, and make it the one to train on."""
        scene.snerg.dataset = ""
        remember(project, "dataset", project.own_dataset, result)
        for warning in result.get("warnings", []):
            self.report({"WARNING"}, warning)
        kept = f"; {result['kept']} of them were kept from the run before and show the scene as it was then" if result.get("kept") else ""
        chosen = scene.snerg.render_depth or scene.snerg.render_normals or scene.snerg.render_light
        without = "; without passes, which only Cycles and EEVEE give" if chosen and scene.render.engine not in ENGINES else ""
        return f"Rendered {result['train']} views to train on and {result['test']} to test on into {project.own_dataset}{kept}{without}"


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
    """The cameras that the settings choose, sorted by name, at each frame if they say so. Raises SnergError where there are none."""
    scene, settings = context.scene, context.scene.snerg
    if settings.cameras == "RIG":
        box = evaluated_box(scene, box_of(scene))
        return list(rig_cameras(box, rig_settings(scene), *resolution(scene)))
    cameras = scene_cameras(context, settings.cameras)
    if not settings.over_frames:
        return list(cameras)
    frames = range(scene.frame_start, scene.frame_end + 1, settings.frame_step)
    if settings.cameras == "ACTIVE":
        return [Moment(active_at(scene, frame), frame) for frame in frames]
    return [Moment(camera, frame) for camera in cameras for frame in frames]


def capture_settings(context: bpy.types.Context) -> CaptureSettings:
    """What of the scene the dataset shows, by the panel's settings."""
    settings = context.scene.snerg
    held_out = settings.test_cameras
    names = tuple(sorted(thing.name_full for thing in held_out.all_objects if thing.type == "CAMERA")) if held_out is not None else ()
    if settings.cameras == "RIG":
        names = ()
    elif held_out is not None and not names:
        raise SnergError(f"The collection {held_out.name!r} of the test cameras holds no camera; choose another under Test Cameras.")
    return CaptureSettings(settings.test_every, names, settings.view_layer, settings.look == "SCENE", chosen_passes(context.scene))


def chosen_passes(scene: bpy.types.Scene) -> tuple[str, ...]:
    """The passes that the panel's settings choose, in the order of render_passes.PASSES; none where the engine has none."""
    settings = scene.snerg
    chosen = {"depth": settings.render_depth, "normal": settings.render_normals}
    wanted = tuple(name for name in PASSES if chosen.get(name, settings.render_light))
    return wanted if scene.render.engine in ENGINES else ()


def scene_cameras(context: bpy.types.Context, which: str) -> list[bpy.types.Object]:
    """The cameras of the scene, sorted by name. which: 'ALL', 'SELECTED' or 'ACTIVE'. Raises SnergError where there are none."""
    if which == "ACTIVE":
        cameras = [context.scene.camera] if context.scene.camera else []
    else:
        cameras = [thing for thing in context.scene.objects if thing.type == "CAMERA" and (which == "ALL" or thing.select_get())]
    if not cameras:
        hint = {"ACTIVE": "no active camera; make one active", "SELECTED": "no camera selected; select some, or choose All or Rig"}
        raise SnergError(f"The scene has {hint.get(which, 'no camera; add some, or choose Rig')}.")
    return sorted(cameras, key=lambda camera: camera.name)
