"""The objects that a baked scene was made of: they stand in its box, and are hidden in its favour."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import bpy
import numpy as np

from .proxy import KEY as PROXY
from .scene_object import is_snerg_object, placement

HIDDEN = "snerg_hidden"  # the custom property of an object that `hide` has hidden
SOLID = {"MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "CURVES", "POINTCLOUD"}
SLACK = 1e-3  # of the box's sides, by which an object may reach out of it and still stands in it


@dataclass
class Originals:
    """Objects by where they stand to the box that was baked: within it; partly; and linked ones, which this file cannot hide."""

    inside: list[bpy.types.Object] = field(default_factory=list)
    reaching: list[bpy.types.Object] = field(default_factory=list)
    linked: list[bpy.types.Object] = field(default_factory=list)


def originals_of(thing: bpy.types.Object, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> Originals:
    """What renders in the box of a SNeRG object's scene, where that was baked, wherever the object stands now."""
    found = Originals()
    for other in scene.objects:
        if other.hide_render or not is_original(other):
            continue
        within, touches = position(thing, corners_of(other, depsgraph))
        if touches and other.library is not None:
            found.linked.append(other)
        elif touches:
            (found.inside if within else found.reaching).append(other)
    return found


def is_original(thing: bpy.types.Object) -> bool:
    """Whether an object may be part of what was baked: it has a surface or volume, or instances, and was not made of a baked scene."""
    if thing.type == "EMPTY":
        return thing.instance_type == "COLLECTION" and thing.instance_collection is not None and not is_snerg_object(thing)
    return thing.type in SOLID and not (is_snerg_object(thing.parent) and (thing.get(PROXY) or thing.type == "VOLUME"))


def corners_of(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """[N, 3], the corners in the world of an object's bounding box; of all instances of a collection, N = 0 where that is empty."""
    matrix = np.array(thing.matrix_world, np.float64)
    if thing.type == "EMPTY":
        members = [member for member in thing.instance_collection.all_objects if is_original(member)]
        parts = [corners_of(member, depsgraph) - thing.instance_collection.instance_offset for member in members]
        points = np.concatenate(parts) if parts else np.zeros((0, 3))
    else:
        points = np.array([list(corner) for corner in thing.evaluated_get(depsgraph).bound_box], np.float64)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def position(thing: bpy.types.Object, corners: np.ndarray) -> tuple[bool, bool]:
    """Whether corners [N, 3] of the world all lie in the box of a SNeRG object's scene, where that was baked; and whether any part does."""
    if not len(corners):
        return False, False
    to_box = np.linalg.inv(placement(thing))
    local, half = corners @ to_box[:3, :3].T + to_box[:3, 3], np.array(thing.snerg.size) / 2
    low, high = local.min(axis=0), local.max(axis=0)
    reach = half * (1 + 2 * SLACK)
    return bool((low >= -reach).all() and (high <= reach).all()), bool((low < half).all() and (high > -half).all())


def hide(things: list[bpy.types.Object], layer: bpy.types.ViewLayer) -> None:
    """Hide objects in the viewport and in renders."""
    for thing in things:
        thing.hide_render, thing[HIDDEN] = True, True
        if layer.objects.get(thing.name) == thing:
            thing.hide_set(True, view_layer=layer)


def show(things: list[bpy.types.Object], layer: bpy.types.ViewLayer) -> None:
    """Undo `hide`."""
    for thing in things:
        thing.hide_render = False
        del thing[HIDDEN]
        if layer.objects.get(thing.name) == thing:
            thing.hide_set(False, view_layer=layer)


def hidden_in(scene: bpy.types.Scene) -> Iterator[bpy.types.Object]:
    """The objects of a scene that `hide` has hidden."""
    return (thing for thing in scene.objects if thing.get(HIDDEN) and thing.hide_render)


def hidden_for(thing: bpy.types.Object, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> list[bpy.types.Object]:
    """Those of them in the box of a SNeRG object's scene."""
    return [other for other in hidden_in(scene) if is_original(other) and position(thing, corners_of(other, depsgraph))[1]]
