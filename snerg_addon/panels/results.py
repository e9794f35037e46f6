"""The list of the project's datasets, fields and scenes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import bpy

from .. import results
from ..dataset_notes import noted_datasets
from ..project import VERSIONS, Project, project_of
from .layout import decibels, draw_sentence, joined, megabytes

ICONS = {"dataset": "IMAGE_BACKGROUND", "field": "LIGHTPROBE_VOLUME", "scene": "OUTLINER_OB_VOLUME"}
ROWS = 5  # that are shown at first; the list scrolls, and can be dragged longer
NAME_SHARE = 0.45  # of a row's width; the rest is for the figures


class SNERG_UL_results(bpy.types.UIList):
    """Datasets, fields and scenes with their figures"""

    bl_idname = "SNERG_UL_results"

    def draw_item(
        self, _context: Any, layout: bpy.types.UILayout, _data: Any, item: Any, _icon: int, _active: Any, _property: str, *_: Any
    ) -> None:
        """What it is, whether it is in use, its name and its figures."""
        row = layout.row(align=True)
        row.label(text="", icon="RADIOBUT_ON" if item.in_use else "RADIOBUT_OFF")
        names = row.split(factor=NAME_SHARE, align=True)
        if item.kind in VERSIONS:
            names.prop(item, "label", text="", emboss=False, icon=ICONS[item.kind])
        else:
            names.label(text=item.shown, icon=ICONS[item.kind])
        names.label(text=figures_of(project_of(bpy.context.scene), item))


def figures_of(project: Project, item: Any) -> str:
    """'100 views, 12.3 MB' of a dataset; '31.2 dB, 12.3 MB' of a field or scene, 'stopped' for a training that did not end.

    item: has the kind and the folder. '' where nothing was recorded.
    """
    folder = Path(item.folder)
    if item.kind in VERSIONS:
        note = project.note_of(folder)
        return joined(decibels(note), megabytes(note)) if note else "stopped" if item.kind == "field" else ""
    note = project.notes().get("dataset", {}) if folder == project.own_dataset else noted_datasets(project).get(folder, {})
    counts = [note[split] for split in ("train", "val", "test") if isinstance(note.get(split), int)]
    return joined(f"{sum(counts)} views" if counts else "", megabytes(note))


def draw_results(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """The list, closed at first, under a line that counts; and a sentence for each folder that was renamed or removed."""
    for sentence in results.lost(project_of(scene), scene):
        draw_sentence(layout.column(align=True), sentence, "ERROR")
    shown = results.shown_results(scene)
    if shown is None or not shown.items:
        return
    header, body = layout.panel_prop(bpy.context.window_manager.snerg_steps, "results")
    header.label(text=counted([item.kind for item in shown.items]), icon="ASSET_MANAGER")
    if body is None:
        return
    body.template_list(SNERG_UL_results.bl_idname, "", shown, "items", shown, "index", rows=min(ROWS, max(2, len(shown.items))))
    chosen = shown.items[shown.active] if 0 <= shown.active < len(shown.items) else None
    delete = header.row()  # not beside the list, whose rows need its whole width
    delete.enabled = chosen is not None and chosen.kind in VERSIONS
    button = delete.operator("snerg.delete_version", text="", icon="TRASH", emboss=False)
    if chosen is not None:
        button.step, button.version = chosen.kind, Path(chosen.folder).name


def counted(kinds: list[str]) -> str:
    """'1 dataset, 2 fields, 3 scenes'"""
    return ", ".join(f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in Counter(kinds).items())
