"""What the panels share: their base classes, and small texts."""

from __future__ import annotations

import textwrap
from typing import Any, ClassVar

import bpy

from ...core.units import file_size
from ..project import project_of

LINE_WIDTH = 38  # characters of a line in a box that fit into the sidebar at its default width
ICON_LINE_WIDTH = 34  # of a line with an icon


class SidebarPanel:
    """Mixed into a panel of the tab SNeRG."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SNeRG"


class Step:
    """A step of the main panel, which opens and closes. key: its property of SNERG_PG_steps. done: the project's step whose presence puts
    a tick into its header."""

    key: ClassVar[str]
    label: ClassVar[str]
    done: ClassVar[str] = ""
    has_command: ClassVar[bool] = True  # whether a terminal can do it, too

    def is_done(self, context: bpy.types.Context) -> bool:
        """Whether the step has a result."""
        return project_of(context.scene).has(self.done)

    def draw(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        """The header, and when it is open the content with the names of the settings on the left."""
        header, body = layout.panel_prop(context.window_manager.snerg_steps, self.key)
        header.label(text=self.label, icon="CHECKMARK" if self.is_done(context) else "RADIOBUT_OFF")
        if body:
            self.draw_body(body, context)
        else:
            self.draw_header(header)

    def draw_body(self, body: bpy.types.UILayout, context: bpy.types.Context) -> None:
        """The content."""
        body.use_property_split = True
        body.use_property_decorate = False
        self.draw_step(body, context.scene.snerg, context)
        if self.has_command:
            row = body.row()
            row.alignment = "RIGHT"
            row.operator("snerg.copy_command", icon="COPYDOWN", emboss=False).step = self.key

    def draw_header(self, header: bpy.types.UILayout) -> None:
        """Buttons of the header while the step is closed."""

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """The settings, the buttons and the result."""
        raise NotImplementedError


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
    """'12 MB'; '' where the size is not known."""
    size = note.get("bytes")
    return file_size(size) if isinstance(size, int | float) else ""


def decibels(note: dict[str, Any]) -> str:
    """'31.2 dB'; '' where the quality is not known."""
    value = note.get("psnr")
    return f"{value:.1f} dB" if isinstance(value, int | float) else ""


def joined(*parts: str) -> str:
    """Those of the parts that are not empty, separated by commas."""
    return ", ".join(part for part in parts if part)
