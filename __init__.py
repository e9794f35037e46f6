"""SNeRG for Blender: from Blender's cameras to a baked radiance field, in Blender and on a web page."""


def register() -> None:
    """Called by Blender when the extension is enabled. The imports wait until then: outside Blender there is no bpy."""
    from . import snerg_addon

    snerg_addon.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from . import snerg_addon

    snerg_addon.unregister()
