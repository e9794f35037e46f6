"""Simulations without a baked cache: their state is not saved with a scene, so that a dataset may show another than the viewport."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import Any

import bpy

NAMED = 3  # objects that a sentence names at most


def simulation_warning(scene: bpy.types.Scene, frames: Sequence[int | None]) -> str:
    """A sentence about simulations without a baked cache; '' where there are none.

    frames: that are rendered, None for the scene's own.
    """
    last = max((scene.frame_current if frame is None else frame for frame in frames), default=scene.frame_current)
    names = sorted(set(unbaked(scene, last)))
    if not names:
        return ""
    return f"The dataset may show {listed(names)} in another state of simulation than the viewport does, unless it is baked; bake it first."


def unbaked(scene: bpy.types.Scene, frame: int) -> Iterator[str]:
    """The names of what is simulated in the scene, at a frame, without a baked cache."""
    world = scene.rigidbody_world
    bodies = world is not None and world.enabled and world.collection and len(world.collection.objects)
    if bodies and not world.point_cache.is_baked and frame > world.point_cache.frame_start:
        yield "the rigid bodies"
    for thing in with_instances(scene):
        if any(modifier.show_render and is_unbaked(modifier, frame) for modifier in thing.modifiers):
            yield repr(thing.name)


def with_instances(scene: bpy.types.Scene) -> Iterator[bpy.types.Object]:
    """The objects of a scene, and of the collections that they stand for."""
    seen: set[bpy.types.Object] = set()
    waiting = list(scene.objects)
    while waiting:
        thing = waiting.pop()
        if thing not in seen:
            seen.add(thing)
            yield thing
            if thing.instance_type == "COLLECTION" and thing.instance_collection is not None:
                waiting.extend(thing.instance_collection.all_objects)


def is_unbaked(modifier: Any, frame: int) -> bool:
    """Whether a modifier simulates, past its first frame, without a baked cache."""
    if modifier.type == "NODES":
        return frame > 1 and any(is_simulation(bake) and not is_stored(modifier, bake) for bake in modifier.bakes)
    if modifier.type == "FLUID":
        domain = modifier.domain_settings if modifier.fluid_type == "DOMAIN" else None
        return domain is not None and frame > domain.cache_frame_start and not domain.has_cache_baked_data
    if modifier.type == "DYNAMIC_PAINT":
        caches = [surface.point_cache for surface in modifier.canvas_settings.canvas_surfaces] if modifier.canvas_settings else []
    else:
        caches = [getattr(getattr(modifier, "particle_system", modifier), "point_cache", None)]
    return any(cache is not None and not cache.is_baked and frame > cache.frame_start for cache in caches)


def is_simulation(bake: Any) -> bool:
    """Whether a bake of a geometry nodes modifier is of a simulation zone."""
    return bake.node is not None and bake.node.bl_idname == "GeometryNodeSimulationOutput"


def is_stored(modifier: Any, bake: Any) -> bool:
    """Whether files of a bake are there. Of one that is packed into the .blend, Blender tells no script."""
    folder = bpy.path.abspath(bake.directory if bake.use_custom_path else modifier.bake_directory)
    return bool(folder) and os.path.isdir(folder) and bool(os.listdir(folder))


def listed(names: Sequence[str]) -> str:
    """'A', 'A and B', 'A, B, C and 5 more'."""
    shown = [name if name.startswith(("'", "the ")) else repr(name) for name in names[:NAMED]]
    if len(names) > NAMED:
        return f"{', '.join(shown)} and {len(names) - NAMED} more"
    return " and ".join([", ".join(shown[:-1]), shown[-1]]) if len(shown) > 1 else shown[0]
