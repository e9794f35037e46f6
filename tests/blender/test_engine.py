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
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.io.images import read_image, to_uint8
from snerg.core.rendering.render import render_scene
from snerg.snerg_addon.bridge import camera_from_blender, set_camera
from snerg.snerg_addon.capture import evaluated
from snerg.snerg_addon.engine import OBJECT_INDEX
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


@pytest.mark.parametrize("projection", ["equirectangular", "fisheye"])
def test_a_panoramic_frame_is_what_snerg_render_writes(stage, projection):
    """Also a border of it."""
    scene, add = stage
    baked = make_snerg((34, 30, 40), fog=False)
    add(baked)
    pose = make_cameras(width=48, height=36)[0].camera_to_world
    focal, widest = (panorama_focal(48, 24), np.pi) if projection == "equirectangular" else ((16.0, 8.0), 1.5)
    set_camera(scene.camera, Camera(48, 24, focal, (24, 12), pose, projection, widest=widest), scene)
    whole = rendered(scene)
    same(whole, wanted(scene, baked))
    assert whole[..., 3].max() > 200
    scene.render.use_border, scene.render.use_crop_to_border = True, True
    scene.render.border_min_x, scene.render.border_max_x, scene.render.border_min_y, scene.render.border_max_y = 0.25, 0.75, 0.0, 0.5
    same(rendered(scene), whole[12:, 12:36])
    scene.render.use_border = scene.render.use_crop_to_border = False


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
    index = next(v for k, v in found.items() if OBJECT_INDEX in k)
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


def test_what_lies_outside_the_clip_planes_is_not_seen(stage, tmp_path):
    """A block from 2.57 to 3.43 before the camera, of two sizes. Depth is that of the planes that cut it, also towards the edges."""
    scene, add = stage
    thing, layer, data = add(block()), scene.view_layers[0], scene.camera.data
    scene.camera.matrix_world = Matrix.Translation((0, 0, 3))
    layer.use_pass_z = True
    for scale in (1, 2):
        thing.scale = (scale,) * 3
        front, back = 3 - scale * (0.5 - 2 / 30), 3 + scale * (0.5 - 2 / 30)
        for start, end, seen in ((3.1, 100, 3.1), (0.1, front - 0.05, None), (0.1, front + 0.1, front), (back + 0.05, 100, None)):
            data.clip_start, data.clip_end = start, end
            depth = next(v for k, v in passes(scene, tmp_path).items() if "Depth" in k)
            if seen is None:
                assert depth.min() > 1e9
            else:
                assert np.abs(depth[8:16, 12:20] - seen).max() < 0.6 / 30 * scale, (scale, start, end)
    layer.use_pass_z = False


def test_the_index_is_that_of_the_first_surface_and_not_of_a_veil_before_it(stage, tmp_path):
    scene, add = stage
    veil, solid = add(block(alpha=2), "veil"), add(block(), "solid")
    veil.location, veil.pass_index, solid.pass_index = (0, 0, 1.5), 3, 7
    scene.camera.matrix_world = Matrix.Translation((0, 0, 4))
    layer = scene.view_layers[0]
    layer.use_pass_object_index = True
    found = passes(scene, tmp_path)
    layer.use_pass_object_index = False
    index, alpha = (next(v for k, v in found.items() if name in k) for name in (OBJECT_INDEX, "Coverage"))
    assert index[12, 16] == 7 and index[0, 0] == 0
    only_veil = (alpha > 0.05) & (alpha < 0.5)
    assert only_veil.any() and not index[only_veil].any()


def test_holdouts_and_what_the_camera_does_not_see(stage):
    scene, add = stage
    near, far = add(block(colour=(255, 0, 0)), "near"), add(block(colour=(0, 255, 0)), "far")
    near.location, near.scale, far.location = (0, 0, 1), (0.3,) * 3, (0, 0, -1)
    scene.camera.matrix_world = Matrix.Translation((0, 0, 5))
    middle, beside = (12, 16), (12, 18)
    near.is_holdout = True
    picture = rendered(scene)
    assert picture[middle][3] == 0 and picture[beside].tolist() == [0, 255, 0, 255]
    near.is_holdout, near.visible_camera = False, False
    assert rendered(scene)[middle].tolist() == [0, 255, 0, 255]
    near.visible_camera = True
    group = bpy.data.collections.new("Group")
    scene.collection.children.link(group)
    group.objects.link(near)
    scene.collection.objects.unlink(near)
    collection = bpy.context.view_layer.layer_collection.children["Group"]
    for name, wanted in (("holdout", [0, 0, 0, 0]), ("indirect_only", [0, 255, 0, 255])):
        setattr(collection, name, True)
        assert rendered(scene)[middle].tolist() == wanted, name
        setattr(collection, name, False)


def test_the_compositor_knows_the_passes(stage, tmp_path):
    scene, add = stage
    add(block(alpha=40))
    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_object_index = True
    tree = bpy.data.node_groups.new("Compositor", "CompositorNodeTree")
    node = tree.nodes.new("CompositorNodeRLayers")
    node.scene, node.layer = scene, layer.name
    found = {socket.name for socket in node.outputs if socket.enabled}
    bpy.data.node_groups.remove(tree)
    layer.use_pass_z = layer.use_pass_object_index = False
    assert found == {"Image", "Alpha", "Coverage", "Depth", OBJECT_INDEX}


def test_alpha_is_the_coverage_with_an_opaque_film_too(stage, tmp_path):
    scene, add = stage
    add(block(alpha=2))
    scene.camera.matrix_world = Matrix.Translation((0, 0, 3))
    with_film = passes(scene, tmp_path)
    scene.render.film_transparent = False
    found = passes(scene, tmp_path)
    alpha, combined = (next(v for k, v in found.items() if k.endswith(name)) for name in ("Coverage.X", "Combined.A"))
    assert 0.05 < alpha[12, 16] < 0.5 and (combined == 1).all()
    assert np.abs(alpha - next(v for k, v in with_film.items() if k.endswith("Combined.A"))).max() < 1e-4


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
