"""Annotations of a scene: empties with a text, which an exported page shows as labels. The text stands in the empty itself."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.errors import SnergError
from ..core.export.annotations import MAX_TEXT, Annotation
from ..core.export.world_units import WorldUnits
from .capture import evaluated

SIZE = 0.1  # Blender units: how large a new empty is drawn


def _is_camera(_settings: Any, thing: bpy.types.Object) -> bool:
    return bool(thing.type == "CAMERA")


class SNERG_PG_note(bpy.types.PropertyGroup):
    """What makes an empty an annotation."""

    text: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Text", description="The label in an exported page; empty: the empty is no annotation", maxlen=MAX_TEXT
    )
    camera: bpy.props.PointerProperty(  # type: ignore[valid-type]
        name="Camera", description="The camera to which the label leads; none: it leads nowhere", type=bpy.types.Object, poll=_is_camera
    )


def notes_of(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The empties of a scene that have a text, by name."""
    return sorted((thing for thing in scene.objects if thing.type == "EMPTY" and thing.snerg_note.text.strip()), key=lambda o: o.name)


def core_annotations(scene: bpy.types.Scene) -> tuple[Annotation, ...]:
    """The scene's annotations, where its empties stand now."""
    notes = notes_of(scene)
    graph = evaluated(scene) if notes else None
    return tuple(_annotation(thing, graph) for thing in notes)


def _annotation(thing: bpy.types.Object, graph: bpy.types.Depsgraph) -> Annotation:
    x, y, z = thing.evaluated_get(graph).matrix_world.translation
    camera = thing.snerg_note.camera
    return Annotation(thing.snerg_note.text, (x, y, z), camera.name if camera else "")


def annotate(empties: list[bpy.types.Object]) -> int:
    """Give empties their names as texts where they have none. Returns how many; those of other files stay as they are."""
    changed = [thing for thing in empties if thing.library is None and not thing.snerg_note.text.strip()]
    for thing in changed:
        thing.snerg_note.text = thing.name
    return len(changed)


def add_note(context: bpy.types.Context) -> bpy.types.Object:
    """An annotation at the 3D cursor. Raises SnergError where the active collection is of another file."""
    empty = bpy.data.objects.new("Annotation", None)
    empty.empty_display_type, empty.empty_display_size = "SPHERE", SIZE
    empty.location = context.scene.cursor.location
    empty.snerg_note.text = empty.name
    try:
        context.collection.objects.link(empty)
    except RuntimeError as error:
        bpy.data.objects.remove(empty)
        raise SnergError(
            f"The collection {context.collection.name!r} cannot hold a new empty; choose another one in the Outliner."
        ) from error
    return empty


def units_of(scene: bpy.types.Scene) -> WorldUnits:
    """The units in which Blender tells the scene's lengths."""
    settings = scene.unit_settings
    return WorldUnits(settings.scale_length if settings.system != "NONE" else 1.0, settings.system.lower())


CLASSES = (SNERG_PG_note,)
