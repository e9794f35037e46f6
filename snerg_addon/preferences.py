"""The add-on's preferences (Edit > Preferences > Add-ons > SNeRG)."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations of properties as values, hence no postponed evaluation here.

import bpy

ADDON = __package__.rpartition(".")[0]  # the extension's own name, by which Blender keeps its preferences
GPU_MEGABYTES = 2048


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

    def draw(self, context: bpy.types.Context) -> None:
        """The settings."""
        self.layout.use_property_split = True
        self.layout.prop(self, "gpu_megabytes")


def gpu_bytes() -> int:
    """Bytes of graphics memory that the viewport may take."""
    addon = bpy.context.preferences.addons.get(ADDON)
    chosen = getattr(addon.preferences, "gpu_megabytes", GPU_MEGABYTES) if addon else GPU_MEGABYTES
    return int(chosen) * 2**20
