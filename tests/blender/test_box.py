"""The box is exactly what Blender draws, or an error; a deleted box is no box."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix
from stage import add_camera, add_plane

from snerg.core.errors import SnergError
from snerg.core.nerf.checkpoint import write_field
from snerg.core.nerf.field import Field
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, init_field
from snerg.core.nerf.sampling import CELLS, Domain
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


def test_a_second_add_box_selects_the_one_that_is_there(scene):
    assert bpy.ops.snerg.add_box() == {"FINISHED"}
    box, plane = scene.snerg.box, add_plane()
    box.select_set(False)
    box.hide_set(True)
    plane.select_set(True)
    bpy.context.view_layer.objects.active = plane
    assert bpy.ops.snerg.add_box() == {"FINISHED"}
    assert scene.snerg.box == box and bpy.context.selected_objects == [box] and bpy.context.object == box
    assert sum(thing.type == "EMPTY" for thing in scene.objects) == 1


def test_a_box_in_an_excluded_collection_is_said(scene):
    bpy.ops.snerg.add_box()
    hidden = bpy.data.collections.new("Put Aside")
    scene.collection.children.link(hidden)
    hidden.objects.link(scene.snerg.box)
    scene.collection.objects.unlink(scene.snerg.box)
    bpy.context.view_layer.layer_collection.children["Put Aside"].exclude = True
    with pytest.raises(RuntimeError, match="a collection that the view layer excludes"):
        bpy.ops.snerg.add_box()


def test_a_fitted_box_keeps_its_rotation(scene):
    add_plane(size=2.0)
    bpy.ops.snerg.add_box()
    box = scene.snerg.box
    box.matrix_world = Matrix.LocRotScale((5, 5, 5), Euler(TURNED), (3, 2, 1))
    assert bpy.ops.snerg.fit_box() == {"FINISHED"}
    bpy.context.view_layer.update()
    assert tuple(box.matrix_world.to_euler()) == pytest.approx(TURNED, abs=1e-5)
    fitted = box_from_blender(box)
    assert fitted.contains(np.array([[x, y, 0] for x in (-1, 1) for y in (-1, 1)])).all()
    assert not fitted.contains(np.array([[1.5, 1.5, 0]])).any()


@pytest.fixture
def with_field(scene):
    """The scene, whose project has a field with content from (1, 2, 3) to (2, 4, 4), and a floater."""
    family = HashModelConfig(HashGrid(levels=2, coarsest=4, finest=8, log2_size=8), width=8)
    params = init_field(family, "diffuse", np.random.default_rng(0))["field"]
    cells = np.zeros((CELLS,) * 3, bool)
    cells[32:64, 64:128, 96:128] = cells[0, 0, 0] = True
    domain = Domain.around(np.zeros(3), np.full(3, 4.0))
    field = Field(family, params, None, domain, cells.ravel(), 0.01, view="diffuse")
    write_field(field, project_of(scene).new_version("field"))
    return scene


def test_the_box_fits_the_fields_content(with_field, capsys):
    assert bpy.ops.snerg.fit_box_to_field() == {"FINISHED"}
    box = box_from_blender(with_field.snerg.box)
    np.testing.assert_allclose(box.corners()[[0, -1]], [[1, 2, 3], [2, 4, 4]], atol=1e-6)
    with_field.snerg.box.matrix_world = Matrix.Translation((9, 9, 9))
    assert bpy.ops.snerg.fit_box_to_field() == {"FINISHED"}
    np.testing.assert_allclose(box_from_blender(with_field.snerg.box).corners()[[0, -1]], [[1, 2, 3], [2, 4, 4]], atol=1e-6)
    said = capsys.readouterr().out
    assert (
        "now encloses the field's content, 1 m x 2 m x 1 m (before: 2 m x 2 m x 2 m). 1 stray group, 0.00% of its cells, is outside" in said
    )


def test_without_a_field_the_box_is_not_fitted_to_one(scene):
    with pytest.raises(RuntimeError, match="There is no field; train or import one"):
        bpy.ops.snerg.fit_box_to_field()
