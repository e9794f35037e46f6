"""Tests of Blender share a process: none may see what another one set."""

from __future__ import annotations

import bpy
import pytest
from stage import add_plane, empty_scene, state


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # what Blender is going to remove can still be set
def test_no_test_sees_what_another_one_set(scene):
    def seen():
        found = state(empty_scene()) | {"file": bpy.data.filepath}
        kinds = "actions", "images", "materials", "node_groups"
        return found | {".session_uid": 0} | {kind: sorted(thing.name for thing in getattr(bpy.data, kind)) for kind in kinds}

    before = seen()
    disturb(bpy.context.scene)
    assert seen() == before
    bpy.ops.mesh.primitive_uv_sphere_add()
    assert tuple(bpy.context.object.location) == (0, 0, 0), "the cursor of the test before"


def disturb(scene) -> None:
    """Change every number and switch of a scene that can be changed, and leave other scenes and data-blocks behind."""
    scene.cursor.location = (4, 5, 6)
    scene.snerg.resolution, scene.world.color = 77, (1, 0, 0)
    for thing in (scene, scene.render, scene.cycles, scene.view_settings, scene.unit_settings, scene.view_layers[0]):
        for prop in thing.bl_rna.properties:
            if prop.is_readonly or prop.identifier.startswith(("frame", "preview_pause")) or getattr(prop, "is_array", False):
                continue
            if prop.type == "BOOLEAN":
                setattr(thing, prop.identifier, not getattr(thing, prop.identifier))
            elif prop.type in ("INT", "FLOAT"):
                setattr(thing, prop.identifier, prop.soft_min)
    scene.frame_set(7)
    add_plane().keyframe_insert("location")
    bpy.data.scenes.new("A")
    bpy.data.worlds.new("A")
    bpy.data.images.new("A", 4, 4)
    bpy.data.node_groups.new("A", "CompositorNodeTree")
