"""The box is exactly what Blender draws, or an error; a deleted box is no box."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest
from mathutils import Euler
from stage import add_camera

from snerg.core.errors import SnergError
from snerg.operators.bake import box_to_bake
from snerg.operators.render_dataset import chosen_shots
from snerg.snerg_addon.bridge import box_from_blender
from snerg.snerg_addon.capture import evaluated
from snerg.snerg_addon.panels.box import BoxStep
from snerg.snerg_addon.project import project_of

TURNED = (0.3, -0.5, 0.8)


def add_empty(name: str, parent: Any = None, scale: Any = (1, 1, 1), rotation: Any = (0, 0, 0), display_size: float = 1.0) -> Any:
    """An empty at (1, 2, 3) in its parent's space."""
    empty = bpy.data.objects.new(name, None)
    bpy.context.scene.collection.objects.link(empty)
    empty.empty_display_type, empty.empty_display_size = "CUBE", display_size
    empty.parent, empty.location, empty.scale, empty.rotation_euler = parent, (1, 2, 3), scale, Euler(rotation)
    bpy.context.view_layer.update()
    return empty


def drawn_corners(empty: Any) -> np.ndarray:
    """The corners [8, 3] of a cube empty as Blender draws them, taken from a mesh cube of the same size that is its child."""
    size = empty.empty_display_size
    mesh = bpy.data.meshes.new("Cube")
    mesh.from_pydata([(x, y, z) for x in (-size, size) for y in (-size, size) for z in (-size, size)], [], [])
    cube = bpy.data.objects.new("Cube", mesh)
    bpy.context.scene.collection.objects.link(cube)
    cube.parent = empty
    bpy.context.view_layer.update()
    return np.array([cube.matrix_world @ vertex.co for vertex in mesh.vertices])


def in_order(corners: np.ndarray) -> np.ndarray:
    return corners[np.lexsort(corners.round(3).T)]


@pytest.mark.parametrize(
    ("parent", "child"),
    [
        ({}, {"scale": (1, 2, 3), "rotation": TURNED}),
        ({"scale": (2, 2, 2), "rotation": TURNED}, {"scale": (0.5, 2, 1), "rotation": (1, 0, 2)}),
        ({"scale": (3, 1, 0.5), "rotation": TURNED}, {"scale": (0.5, 2, 1)}),
        ({"scale": (3, 1, 0.5), "rotation": TURNED}, {"rotation": (0, 0, np.pi / 2), "display_size": 0.7}),
        ({"scale": (-1, 1, 2)}, {"scale": (1, 2, -3)}),
    ],
)
def test_a_box_without_shear_is_where_it_is_drawn(scene, parent, child):
    empty = add_empty("Box", add_empty("Parent", **parent), **child)
    drawn = drawn_corners(empty)
    np.testing.assert_allclose(in_order(box_from_blender(empty, evaluated(scene)).corners()), in_order(drawn), atol=1e-5)


def test_a_sheared_box_is_refused(scene):
    """A rotated cube whose parent is scaled unevenly is sheared, and no box."""
    empty = add_empty("Leaning", add_empty("Parent", scale=(3, 1, 0.5)), rotation=TURNED)
    with pytest.raises(SnergError, match="Leaning: The box is sheared"):
        box_from_blender(empty, evaluated(scene))
    scene.snerg.box = empty
    with pytest.raises(SnergError, match="sheared"):
        box_to_bake(bpy.context, project_of(scene))


def test_a_box_that_was_deleted_is_none(scene):
    """The scene's setting keeps the data-block of an object alive that X deleted."""
    assert bpy.ops.snerg.add_box() == {"FINISHED"}
    assert box_to_bake(bpy.context, project_of(scene)) is not None and BoxStep().is_done(bpy.context)
    bpy.ops.object.delete()
    assert box_to_bake(bpy.context, project_of(scene)) is None and not BoxStep().is_done(bpy.context)
    add_camera()
    scene.snerg.cameras = "RIG"
    with pytest.raises(SnergError, match="There is no box"):
        chosen_shots(bpy.context)
    assert bpy.ops.snerg.add_box() == {"FINISHED"}
    assert box_to_bake(bpy.context, project_of(scene)) is not None
