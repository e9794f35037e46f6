"""Import a field."""

from __future__ import annotations

import bpy

from ..core.artifact import FIELDS
from .import_operator import ImportOperator


class SNERG_OT_import_field(ImportOperator, bpy.types.Operator):
    """Import a trained field, or a checkpoint of the published SNeRG code"""

    bl_idname = "snerg.import_field"
    bl_label = "Import Field"
    bl_options = {"REGISTER"}
    step, label = "field", "Importing the field"
    kinds = FIELDS
    key, noun = "field", "field"
