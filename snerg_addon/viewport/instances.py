"""The SNeRG objects that a viewport shows: those of its view layer, and those that collection instances and geometry nodes show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import bpy
import numpy as np

from ..scene_object import is_snerg_object, snerg_objects


@dataclass(frozen=True, eq=False)
class Shown:
    """thing: the object of the file, not its evaluated copy. matrix: [4, 4] float64, where it, or this instance of it, stands. place:
    numbers that tell it from all others. selected: it, or what instances it, is. holdout: it hides what is behind it, and is not seen."""

    thing: bpy.types.Object
    matrix: np.ndarray
    place: tuple[int, ...]
    selected: bool = False
    holdout: bool = False


def shown_in(context: bpy.types.Context) -> Iterator[Shown]:
    """What a viewport shows, as Blender itself decides for other empties. In Rendered mode what only a render knows of is honoured too,
    as the engine does: holdouts, indirect-only collections, and invisibility to the camera."""
    if not any(True for _ in snerg_objects(bpy.data)):
        return  # a file may have a million instances of other things
    space, layer = context.space_data, context.view_layer
    rendered = space.shading.type == "RENDERED"
    for instance in context.evaluated_depsgraph_get().object_instances:
        evaluated = instance.object
        if evaluated.type != "EMPTY" or not is_snerg_object(evaluated) or not instance.show_self:
            continue
        thing = evaluated.original
        holder = instance.parent.original if instance.is_instance else thing
        if not holder.visible_in_viewport_get(space) or not space.show_object_viewport_empty:
            continue
        if rendered and (not evaluated.visible_camera or thing.indirect_only_get(view_layer=layer)):
            continue
        holdout = rendered and (evaluated.is_holdout or thing.holdout_get(view_layer=layer))
        place = (thing.session_uid, *((holder.session_uid, *instance.persistent_id) if instance.is_instance else ()))
        yield Shown(thing, np.array(instance.matrix_world, np.float64), place, holder.select_get(view_layer=layer), holdout)
