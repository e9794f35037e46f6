"""Importing photographs: cameras with the same projection, their images as backgrounds, the points and the box."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest
from PIL import Image

from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.errors import Cancelled, SnergError
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.distortion import Distortion
from snerg.core.io.images import read_image, write_png
from snerg.core.jobs.task import ThreadTask
from snerg.snerg_addon import bridge
from snerg.snerg_addon.capture import evaluated
from snerg.snerg_addon.panels.dataset import draw_remarks
from snerg.snerg_addon.project import project_of


def looking(angle: float, height: float = 1.0) -> np.ndarray:
    """The pose [4, 4] of an upright camera that looks at the z axis from 4 units away."""
    position = np.array([4 * np.cos(angle), 4 * np.sin(angle), height])
    z = position / np.linalg.norm(position)
    x = np.cross([0, 0, 1], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(z, x), z, position], axis=-1)
    return pose


def write_capture(folder: Path, count: int = 9, width: int = 30, height: int = 40, **more: Any) -> Path:
    """A dataset as nerfstudio writes it, with portrait images, an off-centre principal point, non-square pixels, and `more`."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(count):
        write_png(folder / "images" / f"shot_{i}.png", np.full((height, width, 3), 20 * i, np.uint8))
        frames.append({"file_path": f"images/shot_{i}.png", "transform_matrix": looking(2 * np.pi * i / count).tolist()})
    lens = {"w": width, "h": height, "fl_x": 44.0, "fl_y": 41.0, "cx": 13.5, "cy": 22.25, **more}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def drawn_remarks(scene: Any) -> str:
    """What the dataset panel says of what was passed over. Blender tells no script what was put into a layout."""
    layout = MagicMock()
    layout.panel.return_value = layout, layout
    draw_remarks(layout, project_of(scene).remarks())
    return " ".join(str(call.kwargs["text"]) for call in layout.mock_calls if call.kwargs.get("text"))


def cameras_of(collection: str) -> list[Any]:
    return sorted((thing for thing in bpy.data.collections[collection].objects), key=lambda thing: thing.name)


def test_cameras_see_what_the_photographs_cameras_saw(scene, tmp_path):
    folder = write_capture(tmp_path / "capture")
    scene.snerg.test_every = 4
    assert bpy.ops.snerg.import_dataset(filepath=str(folder)) == {"FINISHED"}
    options = DatasetOptions(4)
    for split, title in (("train", "Training Views"), ("val", "Held-Out Views")):
        wanted = read_dataset(folder, split, options).cameras
        things = cameras_of(title)
        assert len(things) == len(wanted) == (6 if split == "train" else 3)
        for thing, camera in zip(things, wanted, strict=True):
            assert thing.name == Path(camera.name).stem
            back = bridge.camera_from_blender(thing, scene, evaluated(scene))
            assert (back.width, back.height) == (30, 40)
            np.testing.assert_allclose(back.focal, camera.focal, rtol=1e-6)
            np.testing.assert_allclose(back.centre, camera.centre, atol=1e-5)
            np.testing.assert_allclose(back.camera_to_world, camera.camera_to_world, atol=1e-6)
    assert scene.camera.name == "shot_1"
    assert (scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage) == (30, 40, 100)
    assert scene.render.pixel_aspect_y / scene.render.pixel_aspect_x == pytest.approx(44 / 41)


def test_each_camera_has_its_picture_behind_everything(scene, tmp_path):
    folder = write_capture(tmp_path / "capture")
    bpy.ops.snerg.import_dataset(filepath=str(folder))
    for thing in cameras_of("Training Views"):
        data = thing.data
        assert data.show_background_images and len(data.background_images) == 1
        background = data.background_images[0]
        assert Path(bpy.path.abspath(background.image.filepath)).name == f"{thing.name}.png"
        assert background.display_depth == "BACK" and background.frame_method == "STRETCH" and background.alpha == 1
        pixels = np.array(background.image.pixels[:3])
        assert pixels == pytest.approx(read_image(folder / "images" / f"{thing.name}.png")[0, 0] / 255, abs=1e-6)


def test_the_box_the_dataset_and_the_view_are_set(scene, tmp_path):
    folder = write_capture(tmp_path / "capture")
    bpy.ops.snerg.import_dataset(filepath=str(folder))
    box = read_dataset(folder).suggested_box()
    np.testing.assert_allclose(bridge.box_from_blender(scene.snerg.box).size, box.size, rtol=1e-5)
    assert scene.snerg.box.name.startswith("SNeRG Box")
    assert project_of(scene).dataset == folder and project_of(scene).has("dataset")


def test_one_undo_takes_it_back(scene, tmp_path):
    """The scene is changed all at once, when the dataset is read; a dataset that cannot be read changes nothing."""
    before = {kind: len(getattr(bpy.data, kind)) for kind in ("objects", "collections", "cameras", "images")}
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "transforms.json").write_text("{}")
    with pytest.raises(RuntimeError):
        bpy.ops.snerg.import_dataset(filepath=str(tmp_path / "broken"))
    assert before == {kind: len(getattr(bpy.data, kind)) for kind in before}
    assert scene.snerg.dataset == ""
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.snerg.import_dataset(filepath=str(write_capture(tmp_path / "capture")))
    bpy.ops.ed.undo()
    assert before == {kind: len(getattr(bpy.data, kind)) for kind in before}
    bpy.ops.ed.redo()
    assert len(bpy.data.cameras) == before["cameras"] + 9 and bpy.context.scene.snerg.box is not None


def test_what_blender_cannot_show_is_said(scene, tmp_path, capfd):
    folder = write_capture(tmp_path / "capture", k1=0.1, k2=0.01)
    bpy.ops.snerg.import_dataset(filepath=str(folder))
    said = capfd.readouterr().out
    assert "9 have a lens with distortion" in said and "training" in said


@pytest.mark.parametrize(("orientation", "turn", "mirrored"), [(5, -1, True), (6, 1, False), (7, 1, True), (8, -1, False)])
def test_a_picture_that_exif_turns_is_turned_in_the_background(scene, tmp_path, orientation, turn, mirrored):
    """Blender ignores EXIF. A picture stored as 40 x 30, fitted into the view of 30 x 40 and turned, fills it at 4/3 of its size."""
    folder = write_capture(tmp_path / "capture", fl_y=44.0)
    exif = Image.Exif()
    exif[0x0112] = orientation
    for file in (folder / "images").iterdir():
        Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(file, exif=exif)
    bpy.ops.snerg.import_dataset(filepath=str(folder))
    background = cameras_of("Training Views")[0].data.background_images[0]
    assert background.rotation == pytest.approx(turn * np.pi / 2) and background.use_flip_x == mirrored
    assert background.frame_method == "FIT" and background.scale == pytest.approx(4 / 3)


def test_what_was_passed_over_is_shown_in_the_panel(scene, tmp_path):
    folder = write_capture(tmp_path / "capture", sharpen=1.0)
    write_png(folder / "masks" / "other.png", np.zeros((40, 30), np.uint8))
    bpy.ops.snerg.import_dataset(filepath=str(folder))
    shown = drawn_remarks(scene)
    assert "2 notes" in shown and "sharpen" in shown and "other.png" in shown
    scene.snerg.dataset = str(write_capture(tmp_path / "another"))
    assert drawn_remarks(scene) == ""


def test_pictures_of_other_sizes_keep_their_width(scene, tmp_path):
    """A scene has one resolution; the background of a camera with another one fills the width of its view."""
    folder = write_capture(tmp_path / "capture")
    value = json.loads((folder / "transforms.json").read_text())
    for index, (width, height) in ((1, (40, 30)), (2, (20, 40))):
        write_png(folder / "images" / f"shot_{index}.png", np.zeros((height, width, 3), np.uint8))
        value["frames"][index] |= {"w": width, "h": height, "cx": width / 2, "cy": height / 2, "fl_x": 44.0, "fl_y": 41.0}
    (folder / "transforms.json").write_text(json.dumps(value))
    scene.snerg.test_every = 0
    bpy.ops.snerg.import_dataset(filepath=str(folder))
    assert (scene.render.resolution_x, scene.render.resolution_y) == (30, 40)
    fits = {thing.name: thing.data.background_images[0].frame_method for thing in cameras_of("Training Views")}
    assert fits["shot_0"] == "STRETCH" and fits["shot_1"] == "FIT" and fits["shot_2"] == "CROP"
    wide = bridge.camera_from_blender(bpy.data.objects["shot_1"], scene, evaluated(scene))
    assert wide.focal[0] / wide.width == pytest.approx(44 / 40, rel=1e-6)


@pytest.mark.parametrize("listed", [True, False], ids=["cameras", "no frames"])
def test_a_split_without_pictures_is_cameras(scene, dataset, tmp_path, listed):
    """As BlenderNeRF writes it: a test file with cameras whose pictures were never rendered, or with no frames."""
    folder = Path(shutil.copytree(dataset, tmp_path / "nerf"))
    shutil.rmtree(folder / "test")
    value = json.loads((folder / "transforms_test.json").read_text())
    (folder / "transforms_test.json").write_text(json.dumps(value | {"frames": value["frames"] if listed else []}))
    bpy.ops.snerg.import_dataset(filepath=str(folder))
    train, test = (bpy.data.collections[name].objects for name in ("Training Views", "Test Views"))
    assert len(train) == 12 and all(camera.data.background_images for camera in train)
    assert len(test) == (3 if listed else 0) and not any(camera.data.background_images for camera in test)
    for camera, frame in zip(test, value["frames"] if listed else [], strict=True):
        np.testing.assert_allclose(np.array(camera.matrix_world), frame["transform_matrix"], atol=1e-6)


def test_points_come_with_their_colours(scene):
    points, colours = np.random.default_rng(0).normal(size=(50, 3)), np.random.default_rng(1).integers(0, 256, (50, 3), np.uint8)
    thing = bridge.add_points("Points", points, colours, scene.collection)
    co, rgba = np.empty(150, np.float32), np.empty(200, np.float32)
    thing.data.vertices.foreach_get("co", co)
    thing.data.color_attributes["Color"].data.foreach_get("color_srgb", rgba)
    np.testing.assert_allclose(co.reshape(50, 3), points, atol=1e-6)
    np.testing.assert_allclose(rgba.reshape(50, 4)[:, :3], colours / 255, atol=1e-6)
    assert thing.hide_render and len(thing.data.polygons) == 0


@pytest.mark.parametrize("size", [(40, 30), (30, 40), (1080, 1920)])
def test_a_camera_of_any_lens_goes_there_and_back(scene, size):
    width, height = size
    camera = Camera(width, height, (1.3 * width, 1.21 * width), (0.4 * width, 0.63 * height), looking(0.3), name="Odd", near=0.05)
    thing = bpy.data.objects.new("Odd", bpy.data.cameras.new("Odd"))
    scene.collection.objects.link(thing)
    bent = replace(camera, distortion=Distortion("opencv", (0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    for source in (camera, bent):  # Blender shows the same lens without its distortion
        bridge.set_camera(thing, source, scene)
        bpy.context.view_layer.update()
        back = bridge.camera_from_blender(thing, scene, evaluated(scene))
        assert back.distortion is None and (back.width, back.height) == size
        np.testing.assert_allclose(back.focal, camera.focal, rtol=1e-6)
        np.testing.assert_allclose(back.centre, camera.centre, atol=1e-6 * width)
        np.testing.assert_allclose(back.camera_to_world, camera.camera_to_world, atol=1e-6)


def test_a_dataset_that_is_none_is_refused(scene, tmp_path):
    with pytest.raises(RuntimeError, match="No path was given"):
        bpy.ops.snerg.import_dataset()
    with pytest.raises(RuntimeError, match="is no dataset"):
        bpy.ops.snerg.import_dataset(filepath=str(tmp_path))
    folder = write_capture(tmp_path / "capture")
    for image in (folder / "images").iterdir():
        image.write_bytes(b"no picture")
    with pytest.raises(RuntimeError, match=r"shot_.*cannot be read"):
        bpy.ops.snerg.import_dataset(filepath=str(folder))
    assert "capture" not in bpy.data.collections


def test_reading_beside_blender_tells_stops_and_fails_in_one_sentence():
    def fails(progress):
        raise SnergError("There is nothing to read.")

    def asks(progress):
        while True:
            progress(0.5, "reading")

    def breaks(progress):
        raise ValueError("a bug")

    assert ThreadTask(lambda progress: {"a": 1}).wait() == {"a": 1}
    with pytest.raises(SnergError, match="nothing to read"):
        ThreadTask(fails).wait()
    with pytest.raises(SnergError, match="ValueError: a bug"):
        ThreadTask(breaks).wait()
    work = ThreadTask(asks)
    work.cancel()
    with pytest.raises(Cancelled, match="Stopped as you asked"):
        work.wait()


@pytest.mark.parametrize(("name", "size", "views"), [("lego400", (400, 400), 125), ("fern", (504, 378), 20), ("fox", (1080, 1920), 50)])
def test_real_captures_stand_upright_round_the_box(scene, data, name, size, views):
    bpy.ops.snerg.import_dataset(filepath=str(data / name))
    cameras = [thing for thing in scene.objects if thing.type == "CAMERA"]
    assert len(cameras) == views and (scene.render.resolution_x, scene.render.resolution_y) == size
    poses = np.array([np.array(thing.matrix_world) for thing in cameras])
    assert poses[:, 2, 1].mean() > 0.3  # the pictures' up is up
    assert np.linalg.norm(poses[:, :3, 3], axis=-1).max() < 50


def test_a_chosen_dataset_is_kept_relative_to_the_file(scene, tmp_path):
    """A folder that is moved or copied together with its .blend finds its photographs."""
    folder = write_capture(tmp_path / "work" / "photos")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work" / "a.blend"), check_existing=False)
    try:
        bpy.ops.snerg.import_dataset(filepath=str(folder))
        assert bpy.context.scene.snerg.dataset.rstrip("/") == "//photos"
        assert project_of(bpy.context.scene).dataset == folder
    finally:
        bpy.ops.wm.read_homefile(app_template="")
