"""The dataset panel: cameras to render from, or photographs to import."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

from .. import activity
from ..bridge import box_of, resolution
from ..capture import views_rendered
from ..project import Project, no_dataset, project_of
from .layout import LINE_WIDTH, Step, draw_box, joined, megabytes


class DatasetStep(Step):
    """The images to train on"""

    key, label, done = "dataset", "Dataset", "dataset"

    def draw_header(self, header: bpy.types.UILayout) -> None:
        """Importing, in place of rendering."""
        header.operator("snerg.import_dataset", text="", icon="IMPORT", emboss=False)

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """The cameras, the buttons, and the dataset in use."""
        project = project_of(context.scene)
        draw_cameras(layout, settings, context.scene)
        layout.label(text=joined(camera_count(context), "{} x {} px".format(*resolution(context.scene))), icon="OUTLINER_OB_CAMERA")
        draw_passes(layout, settings)
        draw_render(layout, project)
        layout.operator("snerg.import_dataset", icon="IMPORT")
        layout.prop(settings, "dataset", text="Train On")
        if settings.dataset and (problem := no_dataset(project, settings.dataset)):
            draw_box(layout, *textwrap.wrap(problem, LINE_WIDTH))
        note = project.notes().get("dataset", {})
        if note and not settings.dataset:
            views = f"{note.get('train')} + {note.get('test')} test views"
            draw_box(layout, views, joined(f"{note.get('width')} x {note.get('height')} px", megabytes(note)))


def draw_cameras(layout: bpy.types.UILayout, settings: Any, scene: bpy.types.Scene) -> None:
    """Which cameras are rendered, and which of their views are held out."""
    layout.prop(settings, "cameras")
    column = layout.column(align=True)
    if settings.cameras == "RIG":
        column.prop(settings, "rig_count")
        column.prop(settings, "rig_shape")
        column.prop(settings, "rig_angle")
        column.prop(settings, "rig_distance")
        if box_of(scene) is None:
            column.label(text="The rig needs a box", icon="INFO")
    else:
        row = column.row(align=True)
        row.prop(settings, "over_frames")
        if settings.over_frames:
            row.prop(settings, "frame_step")
        column.prop(settings, "test_cameras")
    if settings.cameras == "RIG" or settings.test_cameras is None:
        column.prop(settings, "test_every")
    draw_what(layout, settings, scene)


def draw_what(layout: bpy.types.UILayout, settings: Any, scene: bpy.types.Scene) -> None:
    """Which view layer is rendered, and in which look."""
    column = layout.column(align=True)
    if len(scene.view_layers) > 1 or settings.view_layer:
        column.prop_search(settings, "view_layer", scene, "view_layers")
    column.prop(settings, "look")
    column.label(text=look_of(settings, scene), icon="COLOR")


def look_of(settings: Any, scene: bpy.types.Scene) -> str:
    """'Standard, as on web pages' or 'AgX, Punchy, exposure 1.5': the colours of the dataset."""
    view = scene.view_settings
    if settings.look == "STANDARD":
        same = view.view_transform == "Standard" and view.look == "None" and (view.exposure, view.gamma) == (0, 1)
        return "Colours as F12 shows them" if same else f"Colours in Standard; F12 shows {view.view_transform}"
    parts = [
        view.view_transform,
        *([view.look] if view.look != "None" else []),
        *([f"exposure {view.exposure:g}"] if view.exposure else []),
    ]
    return f"Colours in {', '.join(parts)}"


def draw_passes(layout: bpy.types.UILayout, settings: Any) -> None:
    """Which passes are written beside the pictures."""
    column = layout.column(align=True, heading="Passes")
    for name in ("render_depth", "render_normals", "render_light"):
        column.prop(settings, name)


def draw_render(layout: bpy.types.UILayout, project: Project) -> None:
    """The render button; of an unfinished rendering_key, how far it came and what can be done with it."""
    rendered, total = views_rendered(project.own_dataset)
    if not rendered or any(running.step == "dataset" for running in activity.current(project.folder)):
        layout.operator("snerg.render_dataset", icon="RENDER_STILL")
        return
    column = layout.column(align=True)
    column.label(text=f"{rendered} of {total} views are rendered", icon="INFO")
    column.operator("snerg.render_dataset", icon="RENDER_STILL", text="Render Missing Views").goes_on = True
    column.operator("snerg.render_dataset", text="Render All Again").goes_on = False
    column.operator("snerg.use_views")


def camera_count(context: bpy.types.Context) -> str:
    """'12 cameras': how many views will be rendered."""
    settings = context.scene.snerg
    if settings.cameras == "RIG":
        count = settings.rig_count
    elif settings.cameras == "ACTIVE":
        count = int(context.scene.camera is not None)
    else:
        there = [thing for thing in context.scene.objects if thing.type == "CAMERA"]
        count = len(there) if settings.cameras == "ALL" else sum(camera.select_get() for camera in there)
    cameras = "1 camera" if count == 1 else f"{count} cameras"
    if settings.cameras == "RIG" or not settings.over_frames:
        return cameras
    frames = len(range(context.scene.frame_start, context.scene.frame_end + 1, settings.frame_step))
    return f"{cameras}, {frames} frames"
