"""F12 with the engine SNeRG: frames are what `snerg render` writes, wherever the objects stand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix
from stage import add_camera

from scenes import make_cameras, make_snerg, snerg_from_volume
from snerg.core.export.scene_files import write_scene
from snerg.core.io.images import read_image, to_uint8
from snerg.core.rendering.render import render_scene
from snerg.snerg_addon.bridge import camera_from_blender, set_camera
from snerg.snerg_addon.capture import evaluated
from snerg.snerg_addon.scene_object import make


@pytest.fixture
def stage(scene, tmp_path):
    """A scene that renders with the engine, and what makes an object of a baked scene."""
    scene.render.engine, scene.render.film_transparent = "SNERG", True
    scene.view_settings.view_transform, scene.render.dither_intensity = "Standard", 0.0
    scene.camera = add_camera("Camera", (0, 0, 4))

    def add(baked, name="scene"):
        write_scene(baked, tmp_path / name)
        return make(baked, tmp_path / name, scene.collection)

    scene.render.filepath = str(tmp_path / "frame.png")
    yield scene, add
    scene.render.engine = "CYCLES"


def rendered(scene) -> np.ndarray:
    """F12's picture [H, W, 4] uint8, straight alpha."""
    bpy.ops.render.render(write_still=True)
    return read_image(Path(scene.render.filepath))


def wanted(scene, baked) -> np.ndarray:
    """What `snerg render` writes for the scene's camera."""
    return to_uint8(render_scene(baked, camera_from_blender(scene.camera, scene, evaluated(scene))).straight())


def same(got: np.ndarray, want: np.ndarray, most: float = 1.0) -> None:
    """Alpha, and colours as far as they cover, within `most` levels."""
    got, want = got.astype(float), want.astype(float)
    assert got.shape == want.shape and np.abs(got[..., 3] - want[..., 3]).max() <= most
    assert np.abs(got[..., :3] * got[..., 3:] - want[..., :3] * want[..., 3:]).max() / 255 <= most + 0.01


@pytest.mark.parametrize("which", range(4))
def test_a_frame_is_what_snerg_render_writes(stage, which):
    scene, add = stage
    baked = make_snerg((34, 30, 40), angles=(0.3, -0.2, 0.5), centre=(0.2, 0.1, -0.3), fog=False)
    add(baked)
    set_camera(scene.camera, make_cameras((0.2, 0.1, -0.3), width=48, height=36)[which], scene)
    same(rendered(scene), wanted(scene, baked))


def test_an_object_moved_turned_and_scaled_is_the_scene_there(stage):
    scene, add = stage
    baked = make_snerg((34, 30, 40), fog=False, diffuse=True)
    thing = add(baked)
    thing.matrix_world = Matrix.LocRotScale((0.5, -0.4, 0.2), Euler((0.4, 0.8, -0.3)), (0.7,) * 3)
    set_camera(scene.camera, make_cameras(width=48, height=36)[0], scene)
    there = np.array(thing.matrix_world) @ np.linalg.inv(baked.box.box_to_world) @ baked.grid_to_world
    there[:3, :3] /= 0.7
    moved = replace(baked, grid_to_world=there, voxel_size=0.7 * baked.voxel_size)
    same(rendered(scene), wanted(scene, moved))


def test_the_border_the_percentage_and_the_film(stage):
    scene, add = stage
    baked = make_snerg((34, 30, 40), fog=False, diffuse=True)
    add(baked)
    set_camera(scene.camera, make_cameras(width=96, height=72)[0], scene)
    scene.render.resolution_percentage = 50
    whole = rendered(scene)
    render = scene.render
    render.use_border = render.use_crop_to_border = True
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 0.5, 1.0
    part = rendered(scene)
    render.use_border = render.use_crop_to_border = False
    same(part, whole[:18, 12:36])
    render.film_transparent = False
    scene.world.color = (1, 1, 1)
    over_white = to_uint8(render_scene(baked, camera_from_blender(scene.camera, scene, evaluated(scene))).over())
    assert np.abs(rendered(scene)[..., :3].astype(int) - over_white).max() <= 1


def block(alpha: int = 255, colour=(200, 100, 50)):
    """A box of one colour, opaque, 30 x 30 x 30 voxels of 1/30 unit, centred in the world."""
    values = np.zeros((30, 30, 30, 4), np.uint8)
    values[2:-2, 2:-2, 2:-2] = (*colour, alpha)
    pose = np.eye(4)
    pose[:3, 3] = -0.5
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=1 / 30)


def passes(scene, tmp_path) -> dict[str, np.ndarray]:
    """The layers of a multilayer OpenEXR of the frame, by their pass, [H, W, C]."""
    oiio = pytest.importorskip("OpenImageIO")
    settings = scene.render.image_settings
    if "media_type" in settings.bl_rna.properties:  # Blender 5
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    scene.render.filepath = str(tmp_path / "frame.exr")
    bpy.ops.render.render(write_still=True)
    settings.file_format = "PNG" if "media_type" not in settings.bl_rna.properties else settings.file_format
    if "media_type" in settings.bl_rna.properties:
        settings.media_type = "IMAGE"
        settings.file_format = "PNG"
    file, found = oiio.ImageInput.open(str(tmp_path / "frame.exr")), {}
    part = 0
    while file.seek_subimage(part, 0):  # newer Blenders write a part for each pass
        pixels = file.read_image(part, 0, 0, file.spec().nchannels, "float")
        found |= {name: pixels[..., i] for i, name in enumerate(file.spec().channelnames)}
        part += 1
    file.close()
    return found


def test_depth_is_that_of_an_analytic_scene_and_the_index_its_objects(stage, tmp_path):
    scene, add = stage
    thing = add(block())
    thing.pass_index = 7
    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_object_index = True
    scene.camera.matrix_world = Matrix.Translation((0, 0, 3))
    found = passes(scene, tmp_path)
    layer.use_pass_z = layer.use_pass_object_index = False
    depth = next(v for k, v in found.items() if "Depth" in k)
    index = next(v for k, v in found.items() if "IndexOB" in k)
    middle = slice(10, 14), slice(14, 18)
    assert np.abs(depth[middle] - (3 - (0.5 - 2 / 30))).max() < 0.501 / 30  # half a voxel
    assert depth[0, 0] > 1e9 and (index[middle] == 7).all() and index[0, 0] == 0


def test_objects_hide_each_other_by_depth(stage):
    scene, add = stage
    near, far = add(block(colour=(255, 0, 0)), "red"), add(block(colour=(0, 255, 0)), "green")
    scene.camera.matrix_world = Matrix.Translation((0, 0, 4))
    for above, below, seen in ((near, far, 0), (far, near, 1)):
        above.location, below.location = (0, 0, 0.8), (0, 0, -0.8)
        picture = rendered(scene)
        assert picture[12, 16, seen] == 255 and picture[12, 16, 1 - seen] <= 1


def test_an_animation_follows_the_object(stage, tmp_path):
    scene, add = stage
    thing = add(block())
    for frame, x in ((1, -0.5), (2, 0.5)):
        thing.location.x = x
        thing.keyframe_insert("location", frame=frame)
    scene.camera.matrix_world = Matrix.Translation((0, 0, 3))
    scene.frame_start, scene.frame_end, scene.render.filepath = 1, 2, str(tmp_path / "anim_")
    bpy.ops.render.render(animation=True)
    first, second = (read_image(tmp_path / f"anim_{n:04d}.png")[..., 3] for n in (1, 2))
    across = np.arange(first.shape[1])
    assert (first * across).sum() / first.sum() + 4 < (second * across).sum() / second.sum()


def test_what_cannot_be_rendered_is_said(stage):
    _, add = stage
    thing = add(block())
    thing.scale = (1, 2, 1)
    with pytest.raises(RuntimeError, match="scaled unevenly"):
        bpy.ops.render.render()
    thing.scale = (1, 1, 1)
    thing.snerg.folder = "/nowhere/at/all"
    with pytest.raises(RuntimeError, match="no baked scene in"):
        bpy.ops.render.render()


def test_instances_and_hidden_objects(stage):
    scene, add = stage
    thing = add(block())
    scene.camera.matrix_world = Matrix.Translation((0, 0, 3))
    thing.hide_render = True
    assert not rendered(scene)[..., 3].any()
    thing.hide_render = False
    group = bpy.data.collections.new("Group")
    group.objects.link(thing)
    scene.collection.objects.unlink(thing)
    holder = bpy.data.objects.new("Instance", None)
    holder.instance_type, holder.instance_collection = "COLLECTION", group
    scene.collection.objects.link(holder)
    assert rendered(scene)[12, 16, 3] == 255


def test_blenders_own_panels_are_there_with_the_engine(addon):
    from bl_ui.properties_output import RENDER_PT_format

    assert "SNERG" in RENDER_PT_format.COMPAT_ENGINES
