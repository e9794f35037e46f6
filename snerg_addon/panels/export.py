"""The export panel: a web page, or files for other programs."""

from __future__ import annotations

from typing import Any

import bpy

from ..annotation_objects import notes_of
from ..camera_move import counted, may_move
from ..project import project_of
from ..properties import LOSSY
from .layout import Step, draw_box, joined, megabytes


class ExportStep(Step):
    """The baked scene outside Blender"""

    key, label = "export", "Export"

    def is_done(self, context: bpy.types.Context) -> bool:
        """Whether there is a web page or an exported scene."""
        project = project_of(context.scene)
        return project.has("web") or project.has("reference")

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """The settings, the buttons, and the size of what was exported."""
        layout.prop(settings, "web_cameras")
        layout.prop(settings, "web_thumbnails")
        draw_move(layout, settings, context.scene)
        column = layout.column(align=True)
        column.prop(settings, "codec")
        if settings.codec in LOSSY:
            column.prop(settings, "quality")
        if settings.codec != "scene":
            column.prop(settings, "half_features")
        layout.prop(settings, "single_file")
        draw_page(layout, settings)
        draw_annotations(layout, settings, context.scene)
        layout.operator("snerg.export_web", icon="URL")
        layout.operator("snerg.export_scene", icon="EXPORT")
        project = project_of(context.scene)
        notes = project.notes()
        draw_box(
            layout,
            joined("Web page", megabytes(notes["web"])) if "web" in notes else "",
            joined("Scene files", megabytes(notes["reference"])) if "reference" in notes else "",
        )
        if project.has("web"):
            layout.operator("snerg.open_page", icon="WORLD")


def draw_move(layout: bpy.types.UILayout, settings: Any, scene: bpy.types.Scene) -> None:
    """Whether the page plays the animated camera, and what that adds to it."""
    if not may_move(scene):
        row = layout.row()
        row.enabled = False
        row.label(text="No camera is animated", icon="CAMERA_DATA")
        return
    layout.prop(settings, "web_path")
    if not settings.web_path:
        return
    layout.prop(settings, "web_play")
    known = counted(scene)
    if known:
        layout.label(text=known, icon="CAMERA_DATA")
    else:
        layout.operator("snerg.count_keyframes", icon="CAMERA_DATA")


def draw_page(layout: bpy.types.UILayout, settings: Any) -> None:
    """What the page says about itself, and how it opens, in a part that is closed at first."""
    header, body = layout.panel("SNERG_page", default_closed=True)
    header.label(text="About the Page")
    if body is None:
        return
    for name in ("page_title", "page_description", "page_address", "page_background"):
        body.prop(settings, name)
    if settings.page_background in ("colour", "image"):
        body.prop(settings, f"page_{settings.page_background}")
    body.prop(settings, "page_mode")
    body.prop(settings, "page_quality")
    body.prop(settings, "limits_orbit")
    if settings.limits_orbit:
        body.prop(settings, "orbit_distance")
        body.prop(settings, "orbit_elevation")
    body.prop(settings, "measures")
    body.prop(settings, "enters_vr")


def draw_annotations(layout: bpy.types.UILayout, settings: Any, scene: bpy.types.Scene) -> None:
    """The empties that have a text, in a part that is closed at first: each with its text and its camera."""
    header, body = layout.panel("SNERG_annotations", default_closed=True)
    header.use_property_split = False  # as Blender's own panels with a switch: beside the arrow
    header.prop(settings, "shows_annotations")
    if body is None:
        return
    for thing in notes_of(scene):
        column = body.column(align=True)
        row = column.row(align=True)
        row.prop(thing.snerg_note, "text", text="", icon="EMPTY_DATA")
        row.operator("snerg.remove_annotation", text="", icon="X").name = thing.name
        column.prop(thing.snerg_note, "camera", text="")
    body.operator("snerg.add_annotation", icon="ADD")
