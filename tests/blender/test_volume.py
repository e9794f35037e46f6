"""A scene's OpenVDB volume in Blender: what it lets through, and that it follows the SNeRG object."""

from __future__ import annotations

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest
from stage import add_camera

from scenes import snerg_from_volume
from snerg.core.errors import SnergError
from snerg.core.export.scene_files import write_scene
from snerg.core.export.vdb import open_vdb
from snerg.core.io.images import read_image
from snerg.operators.export_vdb import SNERG_OT_export_vdb
from snerg.snerg_addon.project import project_of
from snerg.snerg_addon.scene_object import folder_of
from snerg.snerg_addon.viewport.loading import cached
from snerg.snerg_addon.volume import add_volume, volume_path

HAZE = Path(__file__).parents[1] / "data" / "haze.vdb"  # what `export-vdb` writes of `haze`
ALPHA, THICK = 5 / 255, 26  # of each voxel, voxels


def haze():
    """A cube of 26 voxels a side that lets some light through, in a box of side 1."""
    values = np.zeros((30, 30, 30, 4), np.uint8)
    values[2:-2, 2:-2, 2:-2] = (4, 2, 1, 5)
    pose = np.eye(4)
    pose[:3, 3] = -0.5
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=1 / 30)


@pytest.fixture
def thing(scene, tmp_path):
    """A SNeRG object of the haze."""
    write_scene(haze(), tmp_path / "haze")
    bpy.ops.snerg.add_scene(directory=str(tmp_path / "haze"))
    return bpy.context.object


def test_a_volume_lets_through_what_the_voxels_do_at_any_scale(scene, thing, tmp_path):
    volume = add_volume(thing, Path(shutil.copy(HAZE, tmp_path)), scene)
    assert volume.parent == thing and add_volume(thing, tmp_path / "haze.vdb", scene) == volume
    thing.scale = (2, 2, 2)
    scene.camera = add_camera("Above", (0, 0, 6))
    render = scene.render
    render.film_transparent, render.filepath = True, str(tmp_path / "haze.png")
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGBA"
    scene.cycles.samples, scene.cycles.seed = 64, 0
    render.resolution_x = render.resolution_y = 12
    bpy.ops.render.render(write_still=True)
    render.film_transparent = False
    alpha = read_image(tmp_path / "haze.png")[4:8, 4:8, 3] / 255
    assert abs(alpha.mean() - (1 - (1 - ALPHA) ** THICK)) < 0.05  # three times the spread of 1024 samples


def made(scene, thing) -> str:
    """What the operator says once its command has written the volume."""
    project = project_of(scene)
    path = volume_path(project, folder_of(thing))
    project.note(f"object of {path.name}", {"name": thing.name_full})
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(HAZE, path)
    return SNERG_OT_export_vdb.finish(None, scene, project, {"out": str(path), "bytes": 1, "left_out": ""})


def test_the_volume_belongs_to_the_object_that_it_was_made_for(scene, thing, tmp_path):
    duplicate = thing.copy()
    scene.collection.objects.link(duplicate)
    assert made(scene, duplicate).endswith(f"added it to {duplicate.name!r} as a volume.")
    assert not thing.children and [child.type for child in duplicate.children] == ["VOLUME"]
    made(scene, thing)
    assert thing.children[0].data == duplicate.children[0].data and len(made(scene, thing)) and len(thing.children) == 1
    for each in (thing, duplicate):
        each.snerg.folder = "/nowhere"
    with_none = SNERG_OT_export_vdb.finish(
        None, scene, project_of(scene), {"out": str(volume_path(project_of(scene), tmp_path / "haze")), "bytes": 1, "left_out": ""}
    )
    assert "no object shows its scene any more" in with_none


def test_scenes_of_the_same_name_have_volumes_of_their_own(scene, tmp_path):
    project = project_of(scene)
    folders = [
        project.scene,
        *(project.folder / "scenes" / name for name in ("001", "002")),
        *(tmp_path / name / "scenes" / "001" for name in "ab"),
    ]
    assert len({volume_path(project, folder) for folder in folders}) == len(folders)


def test_a_packed_scene_becomes_a_volume_from_its_copy(scene, thing, tmp_path):
    bpy.ops.snerg.pack_scene()
    shutil.rmtree(tmp_path / "haze")
    job = SNERG_OT_export_vdb.start(None, bpy.context, project_of(scene))
    source = Path(job.arguments[job.arguments.index("export-vdb") + 1])
    assert cached(source).shape == haze().shape
    assert str(volume_path(project_of(scene), tmp_path / "haze")) in job.arguments


def test_a_linked_objects_volume_and_proxy_are_of_this_file(scene, thing, tmp_path):
    library = bpy.data.collections.new("Library")
    library.objects.link(thing)
    bpy.data.libraries.write(str(tmp_path / "library.blend"), {library}, path_remap="NONE")
    bpy.data.objects.remove(thing)
    bpy.data.collections.remove(library)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, found):
        found.collections = ["Library"]
    scene.collection.children.link(found.collections[0])
    (linked,) = found.collections[0].objects
    made(scene, linked)
    bpy.context.view_layer.objects.active = linked
    assert bpy.ops.snerg.proxy(threshold=0.01) == {"FINISHED"}
    assert {child.type for child in linked.children} == {"VOLUME", "MESH"}
    assert all(child.library is None and child.name in scene.collection.objects for child in linked.children)


def test_without_openvdb_the_operator_says_so(thing):
    try:
        open_vdb()
    except SnergError:
        with pytest.raises(RuntimeError, match="needs the package openvdb"):
            bpy.ops.snerg.export_vdb()
    else:
        assert bpy.ops.snerg.export_vdb() == {"FINISHED"} and thing.children[0].type == "VOLUME"
