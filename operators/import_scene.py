"""A scene that others baked."""

from __future__ import annotations

import bpy

from .import_verb import ImportVerb


class SNERG_OT_import_scene(ImportVerb, bpy.types.Operator):
    """Import a baked scene: one of ours, or the PNG folder of the published SNeRG code"""

    bl_idname = "snerg.import_scene"
    bl_label = "Import Scene"
    bl_options = {"REGISTER"}
    step, label = "bake", "Importing the scene"
    key, what = "scene", "baked scene"
