"""Import a baked scene."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.artifact import SCENES
from ..snerg_addon.project import Project
from ..snerg_addon.scene_object import show_scene
from .import_operator import ImportOperator


class SNERG_OT_import_scene(ImportOperator, bpy.types.Operator):
    """Import a baked scene, or the PNG files of the published SNeRG code"""

    bl_idname = "snerg.import_scene"
    bl_label = "Import Scene"
    bl_options = {"REGISTER"}
    step, label = "bake", "Importing the scene"
    kinds = SCENES
    changes_file = True
    key, noun = "scene", "baked scene"

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Record the new version, put it in use, and show it."""
        before = project.scene
        sentence = ImportOperator.finish(self, scene, project, result)  # by its name: watch.Finisher is no instance
        show_scene(scene, project, project.version_made(self.key, result["to"]), before)
        return sentence
