"""Simulations without a baked cache are named before a dataset is rendered from them."""

from __future__ import annotations

from typing import Any

import bpy
import pytest

from snerg.snerg_addon.shots import Moment, evaluated_shots
from snerg.snerg_addon.simulations import simulation_warning


def cloth(scene: Any) -> Any:
    scene.frame_current = 1
    bpy.ops.mesh.primitive_plane_add(location=(0, 0, 2))
    thing = bpy.context.object
    thing.name = "Sheet"
    thing.modifiers.new("Cloth", "CLOTH")
    return thing


def bodies(scene: Any) -> Any:
    thing = cloth(scene)
    thing.modifiers.clear()
    bpy.ops.rigidbody.world_add()
    bpy.ops.rigidbody.object_add()
    return thing


def paint(scene: Any) -> Any:
    thing = cloth(scene)
    thing.modifiers.clear()
    thing.modifiers.new("Paint", "DYNAMIC_PAINT")
    bpy.ops.dpaint.type_toggle(type="CANVAS")
    return thing


def particles(scene: Any) -> Any:
    thing = cloth(scene)
    thing.modifiers.clear()
    thing.modifiers.new("Dust", "PARTICLE_SYSTEM")
    return thing


def nodes(scene: Any) -> Any:
    thing = cloth(scene)
    thing.modifiers.clear()
    tree = bpy.data.node_groups.new("Grow", "GeometryNodeTree")
    start, end = tree.nodes.new("GeometryNodeSimulationInput"), tree.nodes.new("GeometryNodeSimulationOutput")
    start.pair_with_output(end)
    thing.modifiers.new("Nodes", "NODES").node_group = tree
    return thing


@pytest.mark.parametrize("made", [cloth, bodies, paint, particles, nodes])
def test_what_is_not_baked_is_named_from_the_second_frame(scene, made):
    made(scene)
    name = "rigid bodies" if made is bodies else "Sheet"
    assert simulation_warning(scene, [None]) == "" and name in simulation_warning(scene, [1, 20])
    scene.frame_current = 20
    assert name in simulation_warning(scene, [None])
    scene.frame_current = 1


def test_a_baked_one_is_not_named(scene):
    thing = cloth(scene)
    cache = thing.modifiers["Cloth"].point_cache
    cache.frame_end = 3
    with bpy.context.temp_override(scene=scene, object=thing, active_object=thing, point_cache=cache):
        bpy.ops.ptcache.bake(bake=True)
    assert cache.is_baked and simulation_warning(scene, [3]) == ""


def test_one_in_an_instanced_collection_is_named(scene):
    thing = cloth(scene)
    group = bpy.data.collections.new("Group")
    group.objects.link(thing)
    for other in thing.users_collection:
        if other != group:
            other.objects.unlink(thing)
    holder = bpy.data.objects.new("Holder", None)
    holder.instance_type, holder.instance_collection = "COLLECTION", group
    scene.collection.objects.link(holder)
    assert "Sheet" in simulation_warning(scene, [20])


def test_a_dataset_over_frames_says_it(scene):
    cloth(scene)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    assert not any("bake" in said for said in evaluated_shots(scene, [camera])[1])
    assert any("Sheet" in said and "bake" in said for said in evaluated_shots(scene, [Moment(camera, 1), Moment(camera, 9)])[1])
