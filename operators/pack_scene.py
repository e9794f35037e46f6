"""Keep the scene of a SNeRG object in the .blend, or write it out again."""

from __future__ import annotations

import bpy

from ..core.errors import SnergError
from ..core.units import file_size
from ..snerg_addon import packing
from ..snerg_addon.scene_object import folder_of, is_own
from .scene_object_operator import SceneObjectOperator


class PackingOperator(SceneObjectOperator):
    """Mixed into an operator that changes what the object's own file holds."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object shows a baked scene and is the file's own."""
        return super().poll(context) and is_own(context.object)


class SNERG_OT_pack_scene(PackingOperator, bpy.types.Operator):
    """Keep a copy of the scene's files in this .blend file"""

    bl_idname = "snerg.pack_scene"
    bl_label = "Pack Scene"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Pack."""
        thing = context.object
        try:
            size = packing.pack(thing, folder_of(thing))
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Packed {file_size(size)}; save the file to keep them")
        return {"FINISHED"}


class SNERG_OT_unpack_scene(PackingOperator, bpy.types.Operator):
    """Write the packed scene to its folder, unless that holds it already, and keep no copy in this .blend file any more"""

    bl_idname = "snerg.unpack_scene"
    bl_label = "Unpack Scene"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Unpack."""
        thing, folder = context.object, folder_of(context.object)
        try:
            if packing.is_packed(thing):
                packing.unpack(thing, folder)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        packing.discard(thing)
        self.report({"INFO"}, f"The scene is in {folder}")
        return {"FINISHED"}
