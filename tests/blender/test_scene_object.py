"""The SNeRG object: made where the scene's box stood, kept by the file, its folder's problems said."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from scenes import make_snerg
from snerg.core.export.scene_files import write_scene
from snerg.snerg_addon import packing
from snerg.snerg_addon.packing import is_packed
from snerg.snerg_addon.project import project_of
from snerg.snerg_addon.scene_object import folder_of, is_own, make, placement, problem_of, show_scene, snerg_objects, source_of
from snerg.snerg_addon.viewport.loading import cached, loaded

CENTRE = (0.4, -0.2, 0.3)


def baked(centre=CENTRE, angles=(0.3, -0.2, 0.5)):
    return make_snerg((34, 30, 40), diffuse=True, fog=False, centre=centre, angles=angles)


@pytest.fixture
def source(tmp_path) -> Path:
    """A folder with a baked scene."""
    write_scene(baked(), tmp_path / "elsewhere")
    return tmp_path / "elsewhere"


def objects() -> list[bpy.types.Object]:
    bpy.context.view_layer.update()
    return list(snerg_objects(bpy.context.view_layer))


def test_importing_a_scene_makes_an_object_where_its_box_stood(scene, source):
    assert bpy.ops.snerg.import_scene(filepath=str(source)) == {"FINISHED"}
    (thing,) = objects()
    assert np.allclose(thing.matrix_world, baked().box.box_to_world, atol=1e-6)
    assert folder_of(thing) == project_of(scene).scene and np.allclose(thing.snerg.size, baked().box.size)


def test_add_makes_one_of_the_projects_scene_or_of_a_folder(scene, source):
    assert bpy.ops.snerg.import_scene(filepath=str(source)) == {"FINISHED"}
    assert bpy.ops.snerg.add_scene() == {"FINISHED"}
    assert bpy.ops.snerg.add_scene(directory=str(source)) == {"FINISHED"}
    first, second, third = objects()
    assert bpy.context.object == third and third.select_get() and not first.select_get()
    assert folder_of(second) == project_of(scene).scene and folder_of(third) == source


def test_a_folder_without_a_scene_is_refused_and_makes_nothing(scene, tmp_path):
    with pytest.raises(RuntimeError, match="no baked scene in"):
        bpy.ops.snerg.add_scene(directory=str(tmp_path))
    assert not objects()


def test_a_new_bake_takes_the_old_ones_place_and_keeps_the_artists_moves(scene):
    project = project_of(scene)
    write_scene(baked(), project.folder / "scenes" / "001")
    thing = show_scene(scene, project, project.folder / "scenes" / "001", project.scene)
    move = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.4, 4, "Z") @ Matrix.Scale(0.5, 4)
    thing.matrix_world = move @ thing.matrix_world
    other = baked((0, 0, 0.1), (0, 0, 0))
    write_scene(other, project.folder / "scenes" / "002")
    assert show_scene(scene, project, project.folder / "scenes" / "002", project.folder / "scenes" / "001") is None
    assert objects() == [thing]
    assert np.allclose(thing.matrix_world, np.array(move) @ other.box.box_to_world, atol=1e-5)
    assert folder_of(thing) == project.folder / "scenes" / "002"


def test_all_objects_that_show_the_version_in_use_follow_a_new_bake(scene, source):
    project, scenes = project_of(scene), project_of(scene).folder / "scenes"
    for name in ("001", "002", "003"):
        write_scene(baked(), scenes / name)
    make_things = [make(baked(), scenes / "002", scene.collection) for _ in range(2)]
    older, elsewhere = (make(baked(), folder, scene.collection) for folder in (scenes / "001", source))
    assert show_scene(scene, project, scenes / "003", scenes / "002") is None
    assert [folder_of(thing).name for thing in (*make_things, older, elsewhere)] == ["003", "003", "001", "elsewhere"]
    for thing in make_things:
        bpy.data.objects.remove(thing)
    assert show_scene(scene, project, scenes / "002", scenes / "003") is None and folder_of(older).name == "002"
    bpy.data.objects.remove(older)
    made = show_scene(scene, project, scenes / "003", scenes / "002")
    assert folder_of(made).name == "003" and len(objects()) == 2


def test_another_folder_brings_its_box_and_keeps_the_artists_moves(scene, source, tmp_path):
    parent = bpy.data.objects.new("Parent", None)
    parent.location, parent.rotation_euler = (1, 0, 0), (0, 0, 1)
    scene.collection.objects.link(parent)
    other = make_snerg((64, 30, 34), diffuse=True, fog=False, centre=(1, 2, 3), angles=(0, 0, 0))
    write_scene(other, tmp_path / "other")
    bpy.ops.snerg.add_scene(directory=str(source))
    (thing,) = objects()
    thing.parent = parent
    moved = Matrix.Translation((0, 0, 5)) @ Matrix.Scale(2, 4)
    thing.matrix_basis = moved @ thing.matrix_basis
    thing.snerg.folder = str(tmp_path / "other")
    bpy.context.view_layer.update()
    assert np.allclose(thing.matrix_world, np.array(parent.matrix_world @ moved) @ other.box.box_to_world, atol=1e-5)
    assert np.allclose(thing.snerg.size, other.box.size) and np.allclose(placement(thing), other.box.box_to_world)
    before = [list(row) for row in thing.matrix_basis]
    for folder in ("/nowhere", str(tmp_path / "other")):
        thing.snerg.folder = folder
        assert [list(row) for row in thing.matrix_basis] == before and np.allclose(thing.snerg.size, other.box.size)


def test_it_is_saved_with_the_file_by_a_relative_path(scene, source, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"))
    bpy.ops.snerg.add_scene(directory=str(source))
    assert bpy.context.object.snerg.folder.startswith("//")
    bpy.context.object.location.x = 5
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "file.blend"))
    (thing,) = objects()
    assert thing.location.x == 5 and folder_of(thing) == source
    duplicate = thing.copy()
    assert duplicate.snerg.folder == thing.snerg.folder


def test_what_is_wrong_is_said_of_the_object(scene, source):
    bpy.ops.snerg.add_scene(directory=str(source))
    (thing,) = objects()
    assert problem_of(thing) == "" and loaded(folder_of(thing)).problem == ""
    for scale in ((1, 1, 2), (-1, 1, 1), (0, 0, 0)):
        thing.scale = scale
        bpy.context.view_layer.update()
        assert "scaled unevenly" in problem_of(thing)
    thing.scale = (2, 2, 2)
    bpy.context.view_layer.update()
    assert problem_of(thing) == ""
    thing.snerg.folder = "/nowhere"
    assert "There is no baked scene in /nowhere" in loaded(folder_of(thing)).problem


def test_a_scene_written_again_is_read_again(scene, source):
    bpy.ops.snerg.add_scene(directory=str(source))
    before = loaded(source).scene
    assert loaded(source).scene is before
    write_scene(replace(baked(), near=0.5), source)
    entry = loaded(source)
    entry.thread.join()
    assert entry.scene is not before and entry.scene.near == 0.5


def test_a_packed_scene_outlives_its_folder(scene, source, tmp_path):
    bpy.ops.snerg.add_scene(directory=str(source))
    assert bpy.ops.snerg.pack_scene() == {"FINISHED"}
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "packed.blend"))
    shutil.rmtree(source)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "packed.blend"))
    (thing,) = objects()
    np.testing.assert_array_equal(cached(source_of(thing)).cells, baked().cells)
    bpy.context.view_layer.objects.active = thing
    assert bpy.ops.snerg.unpack_scene() == {"FINISHED"} and source.is_dir() and not is_packed(thing)
    np.testing.assert_array_equal(cached(source_of(thing)).cells, baked().cells)


@pytest.mark.parametrize("foreign", [False, True])
def test_a_packed_scene_outlives_a_folder_that_holds_no_scene_any_more(scene, source, foreign):
    bpy.ops.snerg.add_scene(directory=str(source))
    bpy.ops.snerg.pack_scene()
    (thing,) = objects()
    shutil.rmtree(source)
    source.mkdir()
    if foreign:
        (source / "letter.txt").write_text("not a scene")
    assert packing.state_of(thing, source) == f"There is no scene in {source}; the packed copy is shown"
    np.testing.assert_array_equal(cached(source_of(thing)).cells, baked().cells)
    if foreign:
        with pytest.raises(RuntimeError, match="holds other files"):
            bpy.ops.snerg.unpack_scene()
        assert is_packed(thing) and [path.name for path in source.iterdir()] == ["letter.txt"]
        thing.snerg.folder = str(source.with_name("new"))
    assert bpy.ops.snerg.unpack_scene() == {"FINISHED"} and not is_packed(thing)
    np.testing.assert_array_equal(cached(folder_of(thing)).cells, baked().cells)


def test_another_scene_in_the_folder_neither_replaces_the_packed_one_nor_is_replaced(scene, source):
    bpy.ops.snerg.add_scene(directory=str(source))
    bpy.ops.snerg.pack_scene()
    (thing,) = objects()
    assert packing.state_of(thing, source) == ""
    write_scene(replace(baked(), near=0.5), source)
    assert cached(source_of(thing)).near == 0.5 and "another scene than the folder" in packing.state_of(thing, source)
    with pytest.raises(RuntimeError, match="holds another scene than the one that is packed"):
        bpy.ops.snerg.unpack_scene()
    assert is_packed(thing) and cached(source).near == 0.5
    thing.snerg.folder = str(source.with_name("new"))
    assert cached(source_of(thing)).near == baked().near
    bpy.ops.snerg.unpack_scene()
    assert cached(folder_of(thing)).near == baked().near and cached(source).near == 0.5


def test_a_scene_that_cannot_be_read_is_not_packed_and_says_why(scene, source, monkeypatch):
    bpy.ops.snerg.add_scene(directory=str(source))
    (thing,) = objects()

    def full(self, *_arguments, **_named):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(packing.zipfile.ZipFile, "write", full)
    with pytest.raises(RuntimeError, match=r"Cannot read .*elsewhere \(Input/output error\)"):
        bpy.ops.snerg.pack_scene()
    assert not is_packed(thing)


def test_an_object_follows_its_project_when_the_file_is_saved_first_and_elsewhere(scene, source, tmp_path):
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.snerg.import_scene(filepath=str(source))
    (thing,) = objects()
    for place in ("first", "second/deep"):
        (tmp_path / place).mkdir(parents=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / place / "file.blend"))
        (thing,) = objects()
        assert cached(source_of(thing)).shape == baked().shape, place
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / place / "file.blend"))
        (thing,) = objects()
        assert thing.snerg.folder.startswith("//") and cached(source_of(thing)).shape == baked().shape, place
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "copy.blend"), copy=True)
    assert cached(source_of(objects()[0])).shape == baked().shape


def test_undo_over_saving_loses_no_scene(scene, source, tmp_path):
    """The first save moves the project, the second rewrites the relative path; undo brings both old paths back, redo the new ones."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.snerg.import_scene(filepath=str(source))
    (thing,) = objects()
    bpy.ops.ed.undo_push(message="before")
    for index, place in enumerate(("first", "second/deep"), 1):
        (tmp_path / place).mkdir(parents=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / place / "file.blend"))
        objects()[0].location.x = index
        bpy.ops.ed.undo_push(message="Move")
    for step in (bpy.ops.ed.undo, bpy.ops.ed.undo, bpy.ops.ed.redo, bpy.ops.ed.redo):
        step()
        (thing,) = objects()
        assert folder_of(thing).is_relative_to(tmp_path / "first") and cached(source_of(thing)).shape == baked().shape


@pytest.fixture
def library(scene, source, tmp_path):
    """A file in another folder than the open one, with a collection of one object that shows `source` by a relative path."""
    bpy.ops.wm.read_homefile(use_empty=True)
    library, own = tmp_path / "library" / "library.blend", tmp_path / "deep" / "deeper" / "own.blend"
    for file in (library, own):
        file.parent.mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(library))
    group = bpy.data.collections.new("Group")
    bpy.context.scene.collection.children.link(group)
    make(baked(), source, group)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(own))
    yield library
    bpy.ops.wm.read_homefile(use_empty=False, use_factory_startup=True)


def reopened() -> list[bpy.types.Object]:
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    return list(snerg_objects(bpy.data))


def test_a_linked_object_and_its_override_find_the_scene_from_their_library(library, source):
    bpy.ops.wm.link(directory=f"{library}/Collection/", filename="Group", instance_collections=False)
    (linked,) = snerg_objects(bpy.data)
    assert linked.snerg.folder.startswith("//") and folder_of(linked) == source
    bpy.data.collections["Group"].override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    things = reopened()
    assert len(things) == 2 and sum(thing.library is None for thing in things) == 1
    for thing in things:
        assert folder_of(thing) == source and not is_own(thing) and cached(source_of(thing)).shape == baked().shape
    bpy.context.view_layer.objects.active = next(thing for thing in things if thing.library is None)
    assert not bpy.ops.snerg.pack_scene.poll()


def test_an_override_of_an_override_too(library, source, tmp_path):
    bpy.ops.wm.link(directory=f"{library}/Collection/", filename="Group", instance_collections=False)
    bpy.data.collections["Group"].override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    bpy.ops.wm.save_mainfile()
    second = bpy.data.filepath
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "third.blend"))
    with bpy.data.libraries.load(second, link=True) as (_, found):
        found.scenes = ["Scene"]
    assert {folder_of(thing) for thing in snerg_objects(bpy.data)} == {source}


@pytest.mark.parametrize("what", ["Object/SNeRG", "Collection/Group"])
def test_an_appended_object_finds_its_scene(library, source, what):
    kind, name = what.split("/")
    bpy.ops.wm.append(directory=f"{library}/{kind}/", filename=name)
    (thing,) = reopened()
    assert is_own(thing) and thing.snerg.folder.startswith("//") and folder_of(thing) == source


@pytest.mark.parametrize("way", ["duplicate", "make local"])
def test_a_linked_object_that_becomes_the_files_own_finds_its_scene(library, source, way):
    bpy.ops.wm.link(directory=f"{library}/Object/", filename="SNeRG")
    (linked,) = snerg_objects(bpy.data)
    if way == "duplicate":
        linked.select_set(True)
        bpy.ops.object.duplicate()
        assert [folder_of(thing) for thing in snerg_objects(bpy.data)] == [source] * 2
        bpy.data.objects.remove(linked)
    else:
        linked.make_local()
    (thing,) = snerg_objects(bpy.data)
    assert is_own(thing) and folder_of(thing) == source
    (thing,) = reopened()
    assert not bpy.data.libraries and thing.snerg.folder.startswith("//") and folder_of(thing) == source
