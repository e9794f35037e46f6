"""Export the baked scene as a web page."""

from __future__ import annotations

import math
from typing import Any

import bpy

from ..core.data.readers.camera_files import write_transforms
from ..core.errors import SnergError
from ..core.export.annotations import annotations_json
from ..core.export.page_settings import THUMBNAILS
from ..core.geometry.camera_path import CameraPath, path_bytes
from ..core.io.files import write_bytes
from ..core.io.json_files import json_bytes
from ..core.jobs.runner import start_command
from ..core.jobs.task import Task
from ..snerg_addon.annotation_objects import core_annotations, units_of
from ..snerg_addon.camera_move import camera_move, may_move, remember_count, scene_box
from ..snerg_addon.capture import core_cameras
from ..snerg_addon.project import Project, remember
from ..snerg_addon.properties import LOSSY
from .camera_move_operator import CameraMoveOperator
from .render_dataset import scene_cameras
from .task_operator import TaskOperator


class SNERG_OT_export_web(CameraMoveOperator, TaskOperator, bpy.types.Operator):
    """Export a web page that shows the baked scene in a browser, with the scene's cameras as viewpoints"""

    bl_idname = "snerg.export_web"
    bl_label = "Export Web Page"
    bl_options = {"REGISTER"}
    step, label = "export", "Exporting the web page"
    needs = "scene"

    def needs_move(self, context: bpy.types.Context) -> bool:
        """Whether the page is to play an animated camera."""
        return takes_move(context.scene)

    def go_on(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start the task."""
        return TaskOperator.invoke(self, context, event)

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """The command `bundle`."""
        return start_command(web_arguments(context, project, self._move))

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Record the export."""
        remember(project, "web", project.web, result)
        moves = f", with a camera move of {result['path_frames']} frames" if result.get("path_frames") else ""
        return f"Exported the web page to {project.web}{moves}"


def takes_move(scene: bpy.types.Scene) -> bool:
    """Whether the page is to play an animated camera, by the panel's settings."""
    return bool(scene.snerg.web_path and may_move(scene))


def web_arguments(context: bpy.types.Context, project: Project, move: CameraPath | None = None) -> list[str]:
    """The command line of the export. Writes the current cameras to the project. move: the camera's, where it is evaluated already."""
    settings = context.scene.snerg
    arguments = ["bundle", str(project.scene), "--out", str(project.web)]
    if settings.web_cameras != "ALL" or any(thing.type == "CAMERA" for thing in context.scene.objects):  # a page needs no camera
        cameras = core_cameras(context.scene, scene_cameras(context, settings.web_cameras))
        write_transforms(project.cameras, cameras, [camera.name for camera in cameras])
        arguments += ["--cameras", str(project.cameras)]
        if settings.web_thumbnails != THUMBNAILS:
            arguments += ["--thumbnails", str(settings.web_thumbnails)]
    if takes_move(context.scene):
        path = move or camera_move(context.scene, scene_box(project.scene))
        remember_count(context.scene, path)
        if path.moves:
            write_bytes(project.camera_path, path_bytes(path))
            arguments += ["--path", str(project.camera_path), *(["--play"] if settings.web_play else [])]
    arguments += page_arguments(settings)
    arguments += part_arguments(context.scene, project)
    if settings.codec != "scene":
        arguments += ["--codec", settings.codec]
    if settings.codec in LOSSY:
        arguments += ["--quality", str(settings.quality)]
    if settings.codec != "scene" and settings.half_features:
        arguments.append("--half-features")
    return [*arguments, "--single-file"] if settings.single_file else arguments


def part_arguments(scene: bpy.types.Scene, project: Project) -> list[str]:
    """The options for annotations, measuring and VR. Writes the annotations to the project."""
    settings, units = scene.snerg, units_of(scene)
    notes = core_annotations(scene) if settings.shows_annotations else ()
    arguments = []
    if notes:
        write_bytes(project.annotations, json_bytes(annotations_json(notes)))
        arguments += ["--annotations", str(project.annotations)]
    arguments += ["--measure"] if settings.measures else []
    arguments += ["--vr"] if settings.enters_vr else []
    if settings.measures or settings.enters_vr:
        arguments += ["--unit-scale", f"{units.metres:.9g}", "--unit-system", units.system]
    return arguments


def page_arguments(settings: Any) -> list[str]:
    """The options for what the page says about itself, and how it opens."""
    background = page_background(settings)
    arguments = [] if background == "white" else [f"--background={background}"]
    if settings.page_mode != "orbit":
        arguments += ["--move", settings.page_mode]
    if settings.page_quality != "auto":
        arguments += ["--preset", settings.page_quality]
    for option, text in (
        ("--title", settings.page_title),
        ("--description", settings.page_description),
        ("--address", settings.page_address),
    ):
        if text:
            arguments.append(f"{option}={text}")  # in one word: a text may begin with a dash
    if settings.limits_orbit:
        arguments += ["--orbit-distance", *(f"{value:g}" for value in settings.orbit_distance)]
        arguments += ["--orbit-elevation", *(f"{math.degrees(value):g}" for value in settings.orbit_elevation)]
    return arguments


def page_background(settings: Any) -> str:
    """The value of `--background`. Raises SnergError where a picture is wanted and none is named."""
    if settings.page_background == "colour":
        return "#{:02x}{:02x}{:02x}".format(*(round(255 * value) for value in settings.page_colour))
    if settings.page_background == "image":
        if not settings.page_image:
            raise SnergError("The page's background is to be a picture: choose one under About the Page, or another background.")
        return bpy.path.abspath(settings.page_image)
    return str(settings.page_background)
