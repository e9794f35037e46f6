"""The add-on's preferences (Edit > Preferences > Add-ons > SNeRG)."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations of properties as values, hence no postponed evaluation here.

import textwrap

import bpy

from .. import training_python
from ..preferences import ADDON, GPU_MEGABYTES

LINE_WIDTH = 80  # characters of a line that fit into the preferences' window at its default width


class SNERG_AP_preferences(bpy.types.AddonPreferences):
    """What holds for every file."""

    bl_idname = ADDON

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

    def draw(self, context: bpy.types.Context) -> None:
        """The settings, and what the Python for training says of its devices."""
        self.layout.use_property_split = True
        self.layout.prop(self, "gpu_megabytes")
        row = self.layout.row(align=True)
        row.prop(self, "training_python", placeholder="Blender's own")
        if not self.training_python:
            return
        row.operator("snerg.ask_python", text="", icon="FILE_REFRESH")
        answer = training_python.devices()
        if answer is not None:
            column = self.layout.column(align=True)
            for line in textwrap.wrap(answer.text, LINE_WIDTH):
                column.label(text=line, icon=answer.icon)
