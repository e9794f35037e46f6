"""What a scene consists of in a render: its visible instances and their bounding boxes."""

from __future__ import annotations

from collections.abc import Iterator

import bpy
import numpy as np

from .originals import SOLID


def rendered_instances(depsgraph: bpy.types.Depsgraph) -> Iterator[bpy.types.DepsgraphObjectInstance]:
    """The instances of solid objects that a render shows, from a dependency graph of mode RENDER. One instance is valid at a time."""
    for instance in depsgraph.object_instances:
        thing = instance.object
        if thing.type in SOLID and instance.show_self and not is_empty(thing):
            yield instance


def is_empty(thing: bpy.types.Object) -> bool:
    """Whether an object has no bounding box, as a mesh without vertices."""
    return bool(np.ptp(np.array([list(corner) for corner in thing.bound_box]), axis=0).max() <= 0) and not (
        thing.type == "MESH" and len(thing.data.vertices)
    )


def corners_of(instance: bpy.types.DepsgraphObjectInstance) -> np.ndarray:
    """The corners [8, 3] of an instance's bounding box, in world units."""
    matrix = np.array(instance.matrix_world, np.float64)
    return np.array([list(corner) for corner in instance.object.bound_box], np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def owner_of(instance: bpy.types.DepsgraphObjectInstance) -> bpy.types.Object:
    """The object of the scene, not evaluated, that an instance belongs to: the instancer, or the object itself."""
    thing = instance.parent if instance.is_instance and instance.parent else instance.object
    return thing.original
