"""Conversion between Blender's objects and core's dataclasses, in both directions."""

from __future__ import annotations

import itertools
from dataclasses import replace

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Euler, Vector
from stage import add_camera

from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box
from snerg.snerg_addon import bridge
from snerg.snerg_addon.capture import evaluated

SIZES = [(200, 100), (100, 200), (150, 150), (334, 78)]
ASPECTS = [(1.0, 1.0), (2.0, 1.0), (1.0, 1.5)]


def set_resolution(scene, size, percentage=100, aspect=(1.0, 1.0)):
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *size, percentage
    render.pixel_aspect_x, render.pixel_aspect_y = aspect


def tilted_camera(**settings):
    camera = add_camera("Tilted", (2.0, -3.0, 4.0), **settings)
    camera.rotation_euler = Euler((0.7, 0.1, 0.5))
    camera.scale = (2.0, 2.0, 2.0)
    bpy.context.view_layer.update()
    return camera


@pytest.mark.hard_case(1, 2, 3, 5)
@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
def test_points_land_where_blender_puts_them(scene, fit, kind):
    points = np.random.default_rng(0).normal(size=(20, 3))
    for size, percentage, aspect, shift in itertools.product(SIZES, (100, 50), ASPECTS, ((0.0, 0.0), (0.1, -0.2))):
        set_resolution(scene, size, percentage, aspect)
        blender = tilted_camera(type=kind, sensor_fit=fit, shift_x=shift[0], shift_y=shift[1], sensor_height=20)
        camera = bridge.camera_from_blender(blender, scene, evaluated(scene))
        assert (camera.width, camera.height) == bridge.resolution(scene)
        mine, depth = camera.project(points)
        theirs = np.array([world_to_camera_view(scene, blender, Vector(point)) for point in points])
        expected = np.stack([theirs[:, 0] * camera.width, (1 - theirs[:, 1]) * camera.height], axis=-1)
        assert np.abs(mine - expected)[depth > 0.2].max() < 1e-3, (size, percentage, aspect, shift)
        bpy.data.objects.remove(blender)


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_a_camera_survives_the_way_there_and_back(scene, kind):
    for size, aspect in itertools.product(SIZES, ASPECTS):
        set_resolution(scene, size, 100, aspect)
        blender = tilted_camera(type=kind, sensor_fit="VERTICAL", shift_x=0.1, shift_y=-0.2)
        camera = bridge.camera_from_blender(blender, scene, evaluated(scene))
        other = add_camera("Other")
        bridge.set_camera(other, camera, scene)
        bpy.context.view_layer.update()
        back = bridge.camera_from_blender(other, scene, evaluated(scene))
        assert (back.width, back.height, back.projection) == (camera.width, camera.height, camera.projection)
        np.testing.assert_allclose(back.focal, camera.focal, rtol=1e-5)
        np.testing.assert_allclose(back.centre, camera.centre, atol=1e-3)
        np.testing.assert_allclose(back.camera_to_world, camera.camera_to_world, atol=1e-5)
        assert back.near == pytest.approx(camera.near)


@pytest.mark.hard_case(3)
def test_a_panoramic_camera_of_another_type_is_refused_by_name(scene):
    camera = add_camera("All Round", type="PANO")  # an equisolid fisheye, as Blender makes it
    with pytest.raises(SnergError, match=r"'All Round' is pano.*Fisheye Equisolid"):
        bridge.camera_from_blender(camera, scene, evaluated(scene))


@pytest.mark.hard_case(5)
def test_a_mirrored_or_flat_camera_is_refused(scene):
    camera = add_camera("Odd")
    for scale, reason in (((-1, 1, 1), "mirrors"), ((1, 0, 1), "length 0")):
        camera.scale = scale
        bpy.context.view_layer.update()
        with pytest.raises(SnergError, match=reason):
            bridge.camera_from_blender(camera, scene, evaluated(scene))


def test_the_box_is_what_the_cube_empty_shows(scene):
    parent = bpy.data.objects.new("Parent", None)
    empty = bpy.data.objects.new("Box", None)
    for thing in (parent, empty):
        scene.collection.objects.link(thing)
    empty.empty_display_type, empty.empty_display_size = "CUBE", 0.5
    empty.parent = parent
    parent.location = (1, 2, 3)
    empty.scale, empty.rotation_euler = (1, 2, 3), Euler((0.3, 0.4, 0.5))
    bpy.context.view_layer.update()
    box = bridge.box_from_blender(empty)
    np.testing.assert_allclose(box.size, [1, 2, 3], rtol=1e-6)
    corners = np.array([empty.matrix_world @ Vector(np.multiply(c, 0.5)) for c in itertools.product((-1, 1), repeat=3)])
    np.testing.assert_allclose(box.corners(), corners, atol=1e-5)


def test_a_box_survives_the_way_there_and_back(scene):
    pose = np.eye(4)
    pose[:3, :3] = np.array(Euler((0.3, 0.4, 0.5)).to_matrix())
    pose[:3, 3] = (10, 20, 30)
    box = Box(pose, np.array([1.0, 2.0, 3.0]))
    empty = bpy.data.objects.new("Box", None)
    bridge.set_box(empty, box)
    back = bridge.box_from_blender(empty)
    np.testing.assert_allclose(back.box_to_world, box.box_to_world, atol=1e-5)
    np.testing.assert_allclose(back.size, box.size, rtol=1e-6)


def test_what_is_no_box_is_refused_by_name(scene):
    with pytest.raises(SnergError, match="no box"):
        bridge.box_from_blender(None)
    with pytest.raises(SnergError, match="'Camera' is not an empty"):
        bridge.box_from_blender(add_camera())
    empty = bpy.data.objects.new("Flat", None)
    scene.collection.objects.link(empty)
    empty.scale = (1, 0, 1)
    bpy.context.view_layer.update()
    with pytest.raises(SnergError, match="Flat: The box has no volume"):
        bridge.box_from_blender(empty)


def test_a_picture_arrives_upright_and_unchanged(scene, tmp_path):
    pixels = np.random.default_rng(1).integers(0, 256, (5, 7, 4)).astype(np.float32) / 255
    image = bridge.write_image(pixels)
    assert image.name == "SNeRG Preview" and tuple(image.size) == (7, 5)
    assert image.colorspace_settings.name == "sRGB" and not image.is_float
    shown = np.empty(5 * 7 * 4, np.float32)
    image.pixels.foreach_get(shown)
    np.testing.assert_allclose(shown.reshape(5, 7, 4)[::-1], pixels, atol=1e-6)

    opaque = np.linspace(0, 1, 3 * 4 * 3, dtype=np.float32).reshape(3, 4, 3)
    material = bpy.data.materials.new("Shows it")
    shown_by = material.node_tree.nodes.new("ShaderNodeTexImage")
    shown_by.image = image
    image = bridge.write_image(opaque)
    assert image.name == "SNeRG Preview" and tuple(image.size) == (4, 3) and shown_by.image == image
    image = bridge.write_image(opaque)
    assert len([other for other in bpy.data.images if "SNeRG" in other.name]) == 1
    image.filepath_raw, image.file_format = str(tmp_path / "saved.png"), "PNG"
    image.save()
    from snerg.core.io.images import read_image, to_uint8

    np.testing.assert_array_equal(read_image(tmp_path / "saved.png")[..., :3], to_uint8(opaque))


def test_an_image_of_the_artists_own_keeps_its_pixels(scene):
    theirs = bpy.data.images.new("SNeRG Preview", 4, 4, float_buffer=True)
    ours = bridge.write_image(np.zeros((2, 2, 3), np.float32))
    assert ours != theirs and ours.name == "SNeRG Preview" and theirs.name == "SNeRG Preview (old)"


def test_a_pose_far_away_keeps_blenders_precision(scene):
    camera = bridge.camera_from_blender(add_camera(), scene, evaluated(scene))
    moved = replace(camera, camera_to_world=camera.camera_to_world + np.array([[0, 0, 0, 1024.0]] * 3 + [[0, 0, 0, 0]]))
    other = add_camera("Far")
    bridge.set_camera(other, moved)
    np.testing.assert_allclose(np.array(other.matrix_world), moved.camera_to_world, atol=1e-3)
