"""Add > SNeRG: an object that shows a baked scene."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation of `directory` as a value, hence no postponed evaluation here.

from pathlib import Path

import bpy

from ..core.errors import SnergError
from ..snerg_addon.project import project_of
from ..snerg_addon.properties import RELATIVE_PATHS
from ..snerg_addon.scene_object import make
from ..snerg_addon.viewport.loading import cached


class SNERG_OT_add_scene(bpy.types.Operator):
    """Add an object that shows a baked scene, where the scene's box stood"""

    bl_idname = "snerg.add_scene"
    bl_label = "SNeRG"
    bl_options = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(
        name="Scene",
        description="The folder of the baked scene; the one in use by this file's project where empty",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", *RELATIVE_PATHS},
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Ask for the folder where the project has no baked scene."""
        if self.directory or project_of(context.scene).has("scene") or context.window is None:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Make the object, selected and active."""
        folder = Path(bpy.path.abspath(self.directory)) if self.directory else project_of(context.scene).scene
        try:
            thing = make(cached(folder), folder, context.collection)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for other in context.selected_objects:
            other.select_set(False)
        thing.select_set(True)
        context.view_layer.objects.active = thing
        return {"FINISHED"}
