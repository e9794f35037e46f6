"""Set how long to train and how finely to bake."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation as a value, hence no postponed evaluation here.

import bpy

from ..snerg_addon.presets import PRESETS, apply


class SNERG_OT_apply_preset(bpy.types.Operator):
    """Set the minutes of training and the voxels of the bake"""

    bl_idname = "snerg.apply_preset"
    bl_label = "Apply Preset"
    bl_options = {"REGISTER", "UNDO"}

    preset: bpy.props.EnumProperty(
        name="Preset", items=[(key, preset.name, preset.description) for key, preset in PRESETS.items()], default="GOOD"
    )

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """The tooltip: what the preset is for, and sets."""
        preset = PRESETS[properties.preset]
        return f"{preset.description}. Sets {preset.minutes:g} minutes of training and {preset.resolution} voxels"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set them."""
        apply(PRESETS[self.preset], context.scene)
        return {"FINISHED"}
