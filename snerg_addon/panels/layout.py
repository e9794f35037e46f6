"""What the panels share: their base classes, and small texts."""

from __future__ import annotations

import textwrap
from typing import Any, ClassVar

import bpy

from ..project import project_of

LINE_WIDTH = 38  # characters of a line in a box that fit into the sidebar at its default width
ICON_LINE_WIDTH = 34  # of a line with an icon


class SidebarPanel:
    """Mixed into a panel of the tab SNeRG."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SNeRG"


class StepPanel(SidebarPanel):
    """Mixed into the panel of a step. done: the project's step whose presence puts a tick into the header."""

    bl_parent_id = "SNERG_PT_main"
    done: ClassVar[str] = ""

    def is_done(self, context: bpy.types.Context) -> bool:
        """Whether the step has a result."""
        return project_of(context.scene).has(self.done)

    def draw_header(self: Any, context: bpy.types.Context) -> None:
        """The tick."""
        self.layout.label(text="", icon="CHECKMARK" if self.is_done(context) else "RADIOBUT_OFF")

    def draw(self: Any, context: bpy.types.Context) -> None:
        """The panel's content, with the names of the settings on the left."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        self.draw_step(layout, context.scene.snerg, context)


def draw_box(layout: bpy.types.UILayout, *lines: str) -> None:
    """Draw those of the lines that are not empty in a box."""
    lines = tuple(line for line in lines if line)
    if lines:
        column = layout.box().column(align=True)
        for line in lines:
            column.label(text=line)


def draw_sentence(layout: bpy.types.UILayout, sentence: str, icon: str) -> None:
    """Draw a sentence with an icon, on as many lines as it takes."""
    for index, line in enumerate(textwrap.wrap(sentence, ICON_LINE_WIDTH)):
        layout.label(text=line, icon="BLANK1" if index else icon)


def megabytes(note: dict[str, Any]) -> str:
    """'12.3 MB'; '' where the size is not known."""
    size = note.get("bytes")
    return f"{size / 1e6:.1f} MB" if isinstance(size, int | float) else ""


def decibels(note: dict[str, Any]) -> str:
    """'31.2 dB'; '' where the quality is not known."""
    value = note.get("psnr")
    return f"{value:.1f} dB" if isinstance(value, int | float) else ""


def joined(*parts: str) -> str:
    """Those of the parts that are not empty, separated by commas."""
    return ", ".join(part for part in parts if part)
