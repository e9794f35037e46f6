"""The base of the operators on the active SNeRG object."""

from __future__ import annotations

from typing import Any

import bpy

from ..snerg_addon.scene_object import is_snerg_object


class SceneObjectOperator:
    """Mixed into an operator."""

    poll_message_set: Any

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object shows a baked scene."""
        if is_snerg_object(context.object):
            if context.object.snerg.temporary:
                cls.poll_message_set("The object shows a training and goes away when it ends; bake the field first")
                return False
            return True
        cls.poll_message_set("Select an object that shows a baked scene")
        return False
