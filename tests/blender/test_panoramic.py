"""Blender's panoramic cameras: core's rays are those of Cycles' renders, and a dataset of panoramas comes back."""

from __future__ import annotations

import math

import bpy
import numpy as np
import pytest
from stage import add_camera

from snerg.core.data.load import read_dataset
from snerg.core.errors import SnergError
from snerg.core.io.images import read_image
from snerg.snerg_addon import bridge
from snerg.snerg_addon.capture import evaluated, render_dataset
from snerg.snerg_addon.capture_scene import CaptureSettings
from snerg.snerg_addon.panoramic import lens_of

COLOURS = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0))
# Directions from the camera, in its axes: ahead to the right and up, to the left, behind to the right and down, straight up.
WHERE = ((0.4, 0.3, -1), (-1, 0.1, -0.2), (0.8, -0.5, 0.6), (0.1, 1, -0.1))


def panoramic(kind: str = "EQUIRECTANGULAR", **settings: float) -> bpy.types.Object:
    camera = add_camera("Round", type="PANO")
    lens = lens_of(camera.data)
    lens.panorama_type = kind
    for name, value in settings.items():
        setattr(lens, name, value)
    camera.location, camera.rotation_euler = (0.3, -0.2, 0.5), (1.4, 0.2, 0.6)
    bpy.context.view_layer.update()
    return camera


def glowing(scene: bpy.types.Scene, at: np.ndarray, colour: tuple[int, ...]) -> None:
    bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=8, radius=0.4, location=at)
    material = bpy.data.materials.new("Glow")
    if material.node_tree is None:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    emission, out = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    emission.inputs[0].default_value = (*colour, 1)
    tree.links.new(emission.outputs[0], out.inputs[0])
    bpy.context.object.data.materials.append(material)


def cycles(scene: bpy.types.Scene, width: int, height: int) -> None:
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.render.film_transparent, scene.view_settings.view_transform = True, "Standard"


FISHEYE = {"kind": "FISHEYE_EQUIDISTANT", "fisheye_fov": math.radians(270)}
PART = {"latitude_min": -1.2, "latitude_max": 1.5, "longitude_min": -2.0, "longitude_max": 3.0}


@pytest.mark.parametrize(
    ("size", "settings"),
    [((96, 48), {}), ((80, 60), {}), ((90, 60), PART), ((64, 64), FISHEYE), ((96, 60), FISHEYE)],
    ids=["panorama", "not 2 to 1", "a part", "fisheye", "stretched fisheye"],
)
def test_points_are_where_cycles_shows_them(scene, tmp_path, size, settings):
    camera = panoramic(**settings)
    matrix = np.array(camera.matrix_world)
    places = [matrix[:3, 3] + matrix[:3, :3] @ (5 * np.array(d) / np.linalg.norm(d)) for d in WHERE]
    for place, colour in zip(places, COLOURS, strict=True):
        glowing(scene, place, colour)
    cycles(scene, *size)
    scene.camera, scene.render.filepath = camera, str(tmp_path / "a.png")
    core = bridge.camera_from_blender(camera, scene, evaluated(scene))
    other = add_camera("Other")
    bridge.set_camera(other, core, scene)
    assert np.allclose(bridge.camera_from_blender(other, scene, evaluated(scene)).rays()[1], core.rays()[1], atol=1e-5)
    bpy.ops.render.render(write_still=True)
    picture = read_image(tmp_path / "a.png")
    pixels, _ = core.project(np.array(places))
    found = 0
    for at, colour in zip(pixels, COLOURS, strict=True):
        if not ((at > 3) & (at < np.array(size) - 3)).all():
            continue
        rows, columns = np.nonzero((picture[..., 3] > 128) & ((picture[..., :3] > 128) == np.array(colour, bool)).all(axis=-1))
        assert np.abs(np.array([columns.mean(), rows.mean()]) + 0.5 - at).max() < 1.2
        found += 1
    assert found >= 3


def test_a_dataset_of_panoramas(scene, tmp_path):
    """Pictures, poses and depth, which is the distance from the camera."""
    cameras = [panoramic(), panoramic(**FISHEYE)]
    cameras[1].location = (0.5, 0.4, 0.2)
    for place, colour in zip(((3, 0, 0), (-2, 2, 0), (0, -3, 1)), COLOURS, strict=False):
        glowing(scene, np.array(place), colour)
    cycles(scene, 64, 32)
    render_dataset(scene, cameras, tmp_path / "set", CaptureSettings(test_every=0, passes=("depth",)))
    dataset = read_dataset(tmp_path / "set")
    assert [c.projection for c in dataset.cameras] == ["equirectangular", "fisheye"] and not dataset.remarks()
    expected = [bridge.camera_from_blender(camera, scene, evaluated(scene)) for camera in cameras]
    for index, (found, camera) in enumerate(zip(dataset.cameras, expected, strict=True)):
        assert np.allclose(found.rays()[1], camera.rays()[1], atol=1e-6) and found.widest == pytest.approx(camera.widest)
        column, row = camera.project(np.array([[3.0, 0, 0]]))[0][0].astype(int)
        assert dataset.depth(index)[row, column] == pytest.approx(np.linalg.norm([3, 0, 0] - camera.position) - 0.4, abs=0.05)
    assert dataset.mask(0) is None and not dataset.mask(1)[0, 0]


def test_only_cycles_renders_datasets_of_panoramas(scene, tmp_path):
    scene.render.engine = "BLENDER_WORKBENCH"
    with pytest.raises(SnergError, match=r"'Round'.*Cycles"):
        render_dataset(scene, [panoramic()], tmp_path / "set")


def test_a_shifted_panorama_is_refused(scene):
    camera = panoramic()
    camera.data.shift_x = 0.1
    with pytest.raises(SnergError, match="shifted"):
        bridge.camera_from_blender(camera, scene, evaluated(scene))
