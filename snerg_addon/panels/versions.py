"""The list of versions in the field and bake panels."""

from __future__ import annotations

import textwrap

import bpy

from ..project import Project
from .layout import LINE_WIDTH, decibels, joined, megabytes


def made_with(project: Project, step: str) -> list[str]:
    """Lines that say when the version in use was made, and with which settings."""
    version = project.in_use(step)
    return textwrap.wrap(joined(str(project.note_of(version).get("when", "")), project.settings_of(version)), LINE_WIDTH)


def draw_versions(layout: bpy.types.UILayout, project: Project, step: str) -> None:
    """A row for each version, the newest first: a button to use it, with its quality and size, and buttons to rename and delete it."""
    in_use = project.in_use(step)
    column = layout.column(align=True)
    for version in reversed(project.versions(step)):
        note, row = project.note_of(version), column.row(align=True)
        quality = decibels(note) or ("" if note else "stopped" if step == "field" else "")
        use = row.operator(
            "snerg.use_version",
            text=joined(project.name_of(version), quality, megabytes(note)),
            icon="RADIOBUT_ON" if version == in_use else "RADIOBUT_OFF",
            depress=version == in_use,
        )
        rename = row.operator("snerg.rename_version", text="", icon="GREASEPENCIL")
        delete = row.operator("snerg.delete_version", text="", icon="TRASH")
        for button in (use, rename, delete):
            button.step, button.version = step, version.name
