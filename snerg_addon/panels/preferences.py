"""The add-on's preferences (Edit > Preferences > Add-ons > SNeRG)."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations of properties as values, hence no postponed evaluation here.

import textwrap

import bpy

from .. import flamenco, training_python
from ..folder_pattern import DEFAULT, problem
from ..preferences import ADDON, FLAMENCO_URL, GPU_MEGABYTES
from ..questions import Answer

LINE_WIDTH = 80  # characters of a line that fit into the preferences' window at its default width


class SNERG_AP_preferences(bpy.types.AddonPreferences):
    """What holds for every file."""

    bl_idname = ADDON

    project_pattern: bpy.props.StringProperty(
        name="Project Folder",
        description="Where new projects go: // is the folder of the .blend file, {file} its name, {scene} the name of the scene. "
        "Projects that exist stay where they are",
    )
    gpu_megabytes: bpy.props.IntProperty(
        name="Graphics Memory",
        description="MB of graphics memory that SNeRG objects may take in the viewport; those that do not fit are not drawn there",
        default=GPU_MEGABYTES,
        min=16,
        soft_max=65536,
    )
    training_python: bpy.props.StringProperty(
        name="Python for Training",
        description="Another Python that trains, bakes and studies, such as one with a GPU build of JAX. Empty: Blender's own",
        subtype="FILE_PATH",
    )

    flamenco_url: bpy.props.StringProperty(
        name="Flamenco Manager",
        description="Address of the Manager of a Flamenco render farm. Where one answers, the sidebar offers to send jobs to it",
        default=FLAMENCO_URL,
    )

    def draw(self, context: bpy.types.Context) -> None:
        """The settings, and what the Python for training and the farm say of themselves."""
        self.layout.use_property_split = True
        self.layout.prop(self, "project_pattern", placeholder=DEFAULT)
        if sentence := problem(self.project_pattern):
            draw_answer(self.layout, Answer(sentence, "unready"))
        self.layout.prop(self, "gpu_megabytes")
        row = self.layout.row(align=True)
        row.prop(self, "training_python", placeholder="Blender's own")
        if self.training_python:
            row.operator("snerg.ask_python", text="", icon="FILE_REFRESH")
            draw_answer(self.layout, training_python.devices())
        row = self.layout.row(align=True)
        row.prop(self, "flamenco_url", placeholder="None")
        if self.flamenco_url:
            row.operator("snerg.ask_flamenco", text="", icon="FILE_REFRESH")
            draw_answer(self.layout, flamenco.manager())


def draw_answer(layout: bpy.types.UILayout, answer: Answer | None) -> None:
    """A sentence, on as many lines as it takes."""
    if answer is not None:
        column = layout.column(align=True)
        for line in textwrap.wrap(answer.text, LINE_WIDTH):
            column.label(text=line, icon=answer.icon)
