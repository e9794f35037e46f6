"""Hide Originals: what stands in the box that was baked is hidden and shown again, and nothing else is."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from stage import add_camera, add_plane

from scenes import make_snerg
from snerg.core.export.scene_files import write_scene
from snerg.operators.bake import hint
from snerg.snerg_addon.originals import hidden_in
from snerg.snerg_addon.scene_object import make

CENTRE = (2.0, -1.0, 0.5)


@pytest.fixture
def stage(scene, tmp_path):
    """A turned box of side 2 and more, in which Inside and the instance stand; Floor reaches out; Beside is near."""
    baked = make_snerg((30, 34, 38), diffuse=True, centre=CENTRE, angles=(0, 0, np.pi / 4))
    write_scene(baked, tmp_path / "scene")
    group = bpy.data.collections.new("Group")
    group.instance_offset = (5, 5, 0)
    things = {
        name: add_plane(size, CENTRE) for name, size in (("Inside", 1.0), ("Floor", 5.0), ("Tiny", 0.2), ("Beside", 0.2), ("Gone", 0.2))
    }
    for name, thing in things.items():
        thing.name = name
    things["Beside"].location = CENTRE[0] + 1, CENTRE[1] + 1, CENTRE[2]
    things["Gone"].hide_render = True
    scene.collection.objects.unlink(things["Tiny"])
    group.objects.link(things["Tiny"])
    things["Tiny"].location = (5.1, 5, 0)
    holder = bpy.data.objects.new("Instance", None)
    holder.instance_type, holder.instance_collection, holder.location = "COLLECTION", group, CENTRE
    scene.collection.objects.link(holder)
    add_camera("Camera", CENTRE)
    thing = make(baked, tmp_path / "scene", scene.collection)
    thing.matrix_world = Matrix.Translation((9, 9, 9)) @ thing.matrix_world  # the originals stand where they stood
    bpy.context.view_layer.objects.active = thing
    bpy.context.view_layer.update()
    planes = {name.lower(): other for name, other in things.items()}
    return SimpleNamespace(scene=scene, thing=thing, holder=holder, **planes)


def unseen() -> set[str]:
    """The objects that neither the viewport nor a render shows."""
    return {thing.name for thing in bpy.context.scene.objects if thing.hide_render and thing.hide_get()}


def test_what_stands_in_the_box_is_hidden_and_named_and_shown_again(stage, capfd):
    assert bpy.ops.snerg.hide_originals() == {"FINISHED"}
    assert unseen() == {"Inside", "Instance"}
    said = capfd.readouterr().out
    assert "Hidden in viewport and render: Inside, Instance. Not hidden, because they reach out of the box: Floor." in said
    assert {thing.name for thing in hidden_in(stage.scene)} == unseen()
    assert bpy.ops.snerg.show_originals() == {"FINISHED"}
    assert not unseen() and stage.gone.hide_render and not stage.inside.hide_render
    assert bpy.ops.snerg.show_originals() == {"CANCELLED"}


def test_what_reaches_out_is_hidden_on_request(stage):
    assert bpy.ops.snerg.hide_originals(reaching=True) == {"FINISHED"}
    assert unseen() == {"Inside", "Instance", "Floor"}


def test_undo_shows_them_and_redo_hides_them(stage):
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.snerg.hide_originals("EXEC_DEFAULT", True)
    bpy.ops.ed.undo()
    assert not unseen() and not list(hidden_in(bpy.context.scene))
    bpy.ops.ed.redo()
    assert unseen() == {"Inside", "Instance"}


def test_what_was_made_of_the_scene_is_no_original_and_a_linked_one_is_said(stage, tmp_path, capfd):
    for thing in (stage.inside, stage.floor, stage.holder):
        bpy.data.objects.remove(thing)
    stage.thing.matrix_world = Matrix.Translation((-9, -9, -9)) @ stage.thing.matrix_world
    bpy.ops.snerg.proxy(threshold=0.1)
    assert hint(stage.thing, stage.scene) == "" and bpy.ops.snerg.hide_originals() == {"CANCELLED"}
    other = bpy.data.collections.new("Other")
    plane = add_plane(0.5, CENTRE)
    plane.name = "Linked"
    other.objects.link(plane)
    bpy.data.libraries.write(str(tmp_path / "library.blend"), {other})
    bpy.data.objects.remove(plane)
    bpy.data.collections.remove(other)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, found):
        found.collections = ["Other"]
    stage.scene.collection.children.link(found.collections[0])
    assert "Hide Originals in its Object tab" in hint(stage.thing, stage.scene)
    bpy.ops.snerg.hide_originals()
    assert "Not hidden, because they are linked from another file: Linked." in capfd.readouterr().out and not unseen()
