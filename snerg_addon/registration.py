"""Registration with Blender."""

from __future__ import annotations

from typing import Any

import bpy

from .. import operators
from ..operators import quit, watch
from . import (
    annotation_objects,
    box_gizmo,
    command,
    engine,
    flamenco,
    menus,
    overlay,
    page_server,
    panels,
    pictures,
    properties,
    results,
    saving,
    scene_object,
    steps,
    training_python,
)
from .viewport import draw

CLASSES = (
    *properties.CLASSES,
    *steps.CLASSES,
    *results.CLASSES,
    scene_object.SNERG_PG_object,
    *annotation_objects.CLASSES,
    engine.SNERG_RE_engine,
    *operators.classes(),
    *panels.CLASSES,
    *menus.CLASSES,
    *box_gizmo.CLASSES,
)
_commands: list[Any] = []


def register() -> None:
    """Register the classes first, then what uses them: properties, menus, keys, handlers and the timer."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.snerg = bpy.props.PointerProperty(type=properties.SNERG_PG_scene)
    bpy.types.Object.snerg = bpy.props.PointerProperty(type=scene_object.SNERG_PG_object)
    bpy.types.Object.snerg_note = bpy.props.PointerProperty(type=annotation_objects.SNERG_PG_note)
    steps.register()
    results.register()
    menus.register()
    _commands.append(bpy.utils.register_cli_command("snerg", command.run))
    quit.add_keys()
    saving.register()
    watch.register()
    draw.register()
    overlay.register()
    engine.add_panels()


def unregister() -> None:
    """Undo `register`, in reverse order."""
    engine.remove_panels()
    overlay.unregister()
    pictures.clear()
    draw.unregister()
    watch.unregister()
    training_python.stop()
    page_server.stop()
    flamenco.stop()
    saving.unregister()
    quit.remove_keys()
    while _commands:
        bpy.utils.unregister_cli_command(_commands.pop())
    menus.unregister()
    results.unregister()
    steps.unregister()
    del bpy.types.Object.snerg_note
    del bpy.types.Object.snerg
    del bpy.types.Scene.snerg
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
