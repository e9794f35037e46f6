"""Passes of a rendered dataset: depth and normals where they are known exactly, and light that adds up to the picture."""

from __future__ import annotations

import json
import math
from pathlib import Path

import bpy
import numpy as np
import pytest
from stage import add_camera, contents

from snerg.core.commands.info import info
from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.errors import Cancelled, SnergError
from snerg.core.io.exr import read_channels
from snerg.core.io.images import read_image, srgb_to_linear
from snerg.operators.render_dataset import chosen_passes
from snerg.snerg_addon.capture import CaptureSettings, render_dataset
from snerg.snerg_addon.render_passes import PASSES

RADIUS, CENTRE = 1.0, np.array([0.0, 0.0, 0.0])
HALF, HEIGHT = 2.0, -1.2  # of the square plane


def add_mesh(name: str, material, build) -> None:
    build()
    made = bpy.context.object
    made.name = name
    made.data.materials.append(material)


@pytest.fixture
def stage(scene):
    """A sphere above a plane, a sun, and two cameras that look from the side; one is shifted."""
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    material = bpy.data.materials.new("Plastic")
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (0.6, 0.3, 0.1, 1)
    shader.inputs["Emission Color"].default_value, shader.inputs["Emission Strength"].default_value = (0.0, 0.2, 0.1, 1), 0.2
    add_mesh("Plane", material, lambda: bpy.ops.mesh.primitive_plane_add(size=2 * HALF, location=(0, 0, HEIGHT)))
    add_mesh("Ball", material, lambda: bpy.ops.mesh.primitive_ico_sphere_add(radius=RADIUS, subdivisions=7))
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy = 2.0
    scene.collection.objects.link(sun)
    first = add_camera("First", (3.0, -3.0, 2.0))
    first.rotation_euler = (math.atan2(math.hypot(3, 3), 2.0), 0.0, math.radians(45))
    second = add_camera("Second", (-4.0, 1.0, 2.5), shift_x=0.1, shift_y=-0.05, lens=35)
    second.rotation_euler = (math.atan2(math.hypot(4, 1), 2.5), 0.1, math.atan2(-4, -1))
    bpy.context.view_layer.update()
    return scene, [first, second]


def truth(camera) -> tuple[np.ndarray, np.ndarray]:
    """(depth along the axis [H, W], normals [H, W, 3]) of the ball and the plane, by arithmetic; NaN and 0 where there is neither."""
    origins, directions = camera.rays()
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = (HEIGHT - origins[:, 2]) / directions[:, 2]
        at = origins + floor[:, None] * directions
        floor = np.where((floor > 0) & (np.abs(at[:, :2]) < HALF).all(axis=1), floor, np.inf)
        half = np.einsum("ni,ni->n", directions, origins - CENTRE)
        root = np.sqrt(half**2 - np.einsum("ni,ni->n", origins - CENTRE, origins - CENTRE) + RADIUS**2)
    ball = np.where(np.isfinite(root), -half - root, np.inf)
    along = np.minimum(floor, ball)
    hit = np.isfinite(along)
    normals = np.where((ball < floor)[:, None], (origins + ball[:, None] * directions - CENTRE) / RADIUS, [0, 0, 1])
    depth = np.where(hit, along * (directions @ -camera.camera_to_world[:3, 2]), np.nan)
    shape = camera.height, camera.width
    return depth.reshape(shape), np.where(hit[:, None], normals, 0).reshape(*shape, 3)


def inner(depth: np.ndarray) -> np.ndarray:
    """Pixels whose neighbours are on the same surface: there a mesh of triangles is the sphere that it stands for."""
    steps = [np.abs(depth - np.roll(depth, shift, axis)) for axis in (0, 1) for shift in (-1, 1)]
    return np.all([step < 0.15 for step in steps], axis=0)  # false for NaN


def check_depth(folder: Path) -> None:
    dataset = read_dataset(folder)
    for index, camera in enumerate(dataset.cameras):
        depth, normals = dataset.depth(index), dataset.render_pass(index, "normal")
        known, directions = truth(camera)
        where = inner(known)
        assert where.sum() > 300 and depth.shape == (camera.height, camera.width)
        assert np.abs(depth - known)[where].max() < 1e-3
        assert (np.isfinite(depth) != np.isfinite(known)).sum() <= 2  # an edge may fall on either side of a pixel's centre
        if normals is not None:
            assert np.degrees(np.arccos(np.clip((normals * directions).sum(-1), -1, 1)))[where].max() < 2.5  # flat triangles
            assert not normals[~np.isfinite(depth)].any()


def test_depth_and_normals_are_exact(stage, tmp_path):
    scene, shots = stage
    render_dataset(scene, shots, tmp_path / "set", CaptureSettings(0, passes=("depth", "normal")))
    check_depth(tmp_path / "set")
    layer = scene.view_layers[0]
    assert not layer.use_pass_normal and not layer.use_pass_diffuse_color and scene.cycles.samples == 1
    value = json.loads((tmp_path / "set/transforms_train.json").read_text())
    assert value["frames"][0]["depth_file_path"] == "./depth/train/r_0.exr" and value["depth_unit_scale_factor"] == 1.0
    assert "scene units" in value["snerg_passes"]["depth"] and not value["is_euclidean_depth"]
    stored = read_channels(tmp_path / "set/depth/train/r_0.exr")
    assert list(stored) == ["Y"] and np.isfinite(stored["Y"]).all() and stored["Y"].min() == 0
    described = info(tmp_path / "set")
    assert described["depth"] == {
        "views": 2,
        "missing": 0,
        "stored": "along the axis",
        "unit": 1.0,
        "first_view": pytest.approx(described["depth"]["first_view"]),
    }
    assert described["passes"] == {"normal": 2, "diffuse": 0, "glossy": 0}


def test_depth_is_read_at_a_reduced_size(stage, tmp_path):
    scene, shots = stage
    scene.render.resolution_x, scene.render.resolution_y = 192, 144
    render_dataset(scene, shots, tmp_path / "set", CaptureSettings(0))
    dataset = read_dataset(tmp_path / "set", options=DatasetOptions(downscale=3))
    known, _ = truth(dataset.cameras[0])
    where = inner(known)
    assert dataset.depth(0).shape == (48, 64) and np.abs(dataset.depth(0) - known)[where].max() < 0.02  # a third of a pixel


def test_an_orthographic_camera_has_depth_along_its_axis(stage, tmp_path):
    scene, shots = stage
    shots[0].data.type, shots[0].data.ortho_scale = "ORTHO", 5.0
    render_dataset(scene, shots[:1] * 2, tmp_path / "set", CaptureSettings(0))
    check_depth(tmp_path / "set")


@pytest.mark.parametrize("name", ["subset", "persistent", "image"])
def test_depth_is_exact_whatever_the_scene_is_set_to(stage, tmp_path, name):
    """Rendering a part of the samples, data kept between renders, and an artist's image with the name of Blender's own result."""
    scene, shots = stage
    if name == "subset":
        scene.cycles.sample_offset = 5
        if hasattr(scene.cycles, "use_sample_subset"):  # Blender before 5.0 has the offset alone
            scene.cycles.use_sample_subset = True
    elif name == "persistent":
        scene.render.use_persistent_data = True
    else:
        for image in bpy.data.images:  # a new file may have Blender's own
            image.name = "Another"
        bpy.data.images.new("Render Result", 4, 4)
    render_dataset(scene, shots, tmp_path / "set", CaptureSettings(0, passes=("depth", "normal")))
    check_depth(tmp_path / "set")


def test_light_passes_add_up_to_the_picture(stage, tmp_path):
    """Nothing here transmits or scatters light, so that the picture is the diffuse and the glossy light and no other."""
    scene, shots = stage
    scene.cycles.samples = 16
    render_dataset(scene, shots, tmp_path / "set", CaptureSettings(0, passes=PASSES))
    check_depth(tmp_path / "set")
    dataset = read_dataset(tmp_path / "set")
    diffuse, glossy = (dataset.render_pass(0, name) for name in ("diffuse", "glossy"))
    picture = dataset.read(0).astype(np.float32) / 255
    alpha, linear = picture[..., 3:], srgb_to_linear(picture[..., :3]) * picture[..., 3:]
    assert np.abs(diffuse[..., 3:] - alpha).max() < 0.01
    assert 0.001 < glossy[..., :3].mean() < diffuse[..., :3].mean()
    solid = (alpha[..., 0] == 1) & (picture[..., :3] < 1).all(axis=-1)
    assert solid.sum() > 500
    assert np.abs(diffuse[..., :3] + glossy[..., :3] - linear)[solid].max() < 0.01  # 8 bits of sRGB
    assert np.abs(read_image(tmp_path / "set/diffuse/train/r_0.exr")[..., 1].astype(int)).max() > 20  # other tools open it


def test_a_stopped_rendering_goes_on_with_its_passes(stage, tmp_path):
    scene, shots = stage
    settings = CaptureSettings(2, passes=("depth", "diffuse"))

    def stop(fraction: float, text: str) -> None:
        if fraction > 0:
            raise Cancelled("stop")

    render_dataset(scene, shots, tmp_path / "whole", settings)
    with pytest.raises(Cancelled):
        render_dataset(scene, shots, tmp_path / "set", settings, progress=stop)
    part = tmp_path / "set.unfinished"
    assert sorted(path.relative_to(part).as_posix() for path in part.rglob("*.exr")) == ["depth/train/r_0.exr", "diffuse/train/r_0.exr"]
    assert render_dataset(scene, shots, tmp_path / "set", settings)["kept"] == 1
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")
    with pytest.raises(Cancelled):
        render_dataset(scene, shots, tmp_path / "set", settings, progress=stop)
    assert "kept" not in render_dataset(scene, shots, tmp_path / "set", CaptureSettings(2))  # other passes: from the start
    assert not (tmp_path / "set/diffuse").exists()


def test_passes_can_be_left_out_and_wrong_ones_are_refused(stage, tmp_path):
    scene, shots = stage
    render_dataset(scene, shots, tmp_path / "set", CaptureSettings(0, passes=()))
    assert not list((tmp_path / "set").rglob("*.exr")) and read_dataset(tmp_path / "set").depth(0) is None
    assert info(tmp_path / "set")["depth"] is None
    with pytest.raises(SnergError, match="no pass 'mist'"):
        render_dataset(scene, shots, tmp_path / "other", CaptureSettings(0, passes=("mist",)))


def test_the_panel_chooses_passes(scene):
    assert chosen_passes(scene) == ("depth",)
    scene.snerg.render_depth, scene.snerg.render_light = False, True
    assert chosen_passes(scene) == ("diffuse", "glossy")
    scene.render.engine = "BLENDER_WORKBENCH"
    assert chosen_passes(scene) == ()


@pytest.mark.slow
def test_eevee_gives_the_same_depth(stage, tmp_path):
    """Software rendering takes half a minute to start."""
    scene, shots = stage
    scene.eevee.taa_render_samples = 1
    scene.render.engine = "BLENDER_EEVEE_NEXT" if bpy.app.version < (5, 0) else "BLENDER_EEVEE"
    try:
        render_dataset(scene, shots[1:] * 2, tmp_path / "set", CaptureSettings(0, passes=PASSES))
    except SnergError as error:
        pytest.skip(f"EEVEE does not render here: {error}")
    finally:
        scene.render.engine = "CYCLES"
    check_depth(tmp_path / "set")
    assert read_dataset(tmp_path / "set").render_pass(0, "diffuse")[..., :3].max() > 0.05
