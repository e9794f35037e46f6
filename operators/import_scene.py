"""Import a baked scene."""

from __future__ import annotations

import bpy

from .import_operator import ImportOperator


class SNERG_OT_import_scene(ImportOperator, bpy.types.Operator):
    """Import a baked scene, or the PNG files of the published SNeRG code"""

    bl_idname = "snerg.import_scene"
    bl_label = "Import Scene"
    bl_options = {"REGISTER"}
    step, label = "bake", "Importing the scene"
    key, noun = "scene", "baked scene"
