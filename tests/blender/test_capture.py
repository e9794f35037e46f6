"""A rendered dataset has the scene's own colours and cameras, and leaves the scene as it was."""

from __future__ import annotations

import json
import math

import bpy
import numpy as np
import pytest
from mathutils import Euler
from stage import add_camera, add_plane, contents, state

from snerg.core.data.load import read_dataset
from snerg.core.data.rig import RigSettings, rig_cameras
from snerg.core.errors import Cancelled, SnergError
from snerg.core.geometry.box import Box
from snerg.core.io.images import read_image
from snerg.snerg_addon import capture
from snerg.snerg_addon.bridge import camera_from_blender
from snerg.snerg_addon.capture import CaptureSettings, evaluated, render_dataset, split_names, unfinished, views_rendered


def odd_settings(scene):
    """Settings that rendering a dataset must neither use nor change."""
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Punchy"
    scene.view_settings.exposure, scene.view_settings.gamma = 1.5, 1.4
    scene.view_settings.use_curve_mapping = True
    render = scene.render
    render.dither_intensity, render.film_transparent = 2.0, False
    render.use_border, render.border_max_x, render.use_crop_to_border = True, 0.5, True
    render.image_settings.file_format, render.image_settings.color_mode = "JPEG", "RGB"
    render.filepath = "//somewhere/else"
    render.use_stamp = True
    scene.timeline_markers.new("Cut", frame=1).camera = add_camera("Bound to the marker", (50, 0, 0))


@pytest.fixture
def odd(scene):
    yield odd_settings(scene)
    scene.timeline_markers.clear()
    view, render = scene.view_settings, scene.render
    view.look, view.view_transform = "None", "Standard"
    view.exposure, view.gamma, view.use_curve_mapping = 0, 1, False
    render.dither_intensity, render.use_border, render.use_crop_to_border, render.use_stamp = 1.0, False, False, False
    render.image_settings.file_format = "PNG"


@pytest.mark.hard_case(7, 8)
def test_emission_comes_out_as_its_srgb_value_and_nothing_else_changes(scene, odd, tmp_path):
    add_plane(size=1.0, emission=0.5)
    shots = [add_camera(), add_camera("Second", (0, 0, 4))]
    scene.camera = shots[1]
    bpy.context.view_layer.update()
    before = state(scene)
    result = render_dataset(scene, shots, tmp_path / "set", CaptureSettings(test_every=2))
    assert state(scene) == before
    assert result == {"train": 1, "test": 1, "width": 32, "height": 24}
    pixels = read_image(tmp_path / "set" / "train" / "r_0.png").astype(int)
    assert pixels.shape == (24, 32, 4)
    solid = pixels[pixels[..., 3] == 255]
    assert len(solid) > 20
    assert np.abs(solid[:, :3] - 188).max() <= 1  # 0.5 linear is 187.5 of 255 in sRGB
    assert (pixels[0, 0] == [0, 0, 0, 0]).all()
    edge = pixels[(pixels[..., 3] > 40) & (pixels[..., 3] < 255)]
    assert len(edge) == 0 or np.abs(edge[:, :3] - 188).max() <= 4  # straight alpha: an edge has the object's own colour


def test_the_files_are_what_any_nerf_tool_reads(scene, tmp_path):
    add_plane()
    shots = [add_camera(f"Camera {index}", (0, 0, 4 + index)) for index in range(5)]
    box = Box.axis_aligned([-1, -1, -1], [1, 1, 1])
    render_dataset(scene, shots, tmp_path / "set", CaptureSettings(test_every=3), box)
    value = json.loads((tmp_path / "set" / "transforms_train.json").read_text())
    assert [frame["file_path"] for frame in value["frames"]] == [f"./train/r_{index}" for index in range(4)]
    assert value["camera_angle_x"] == pytest.approx(shots[0].data.angle_x, rel=1e-5)
    assert value["snerg_render"]["view_transform"] == "Standard" and value["snerg_render"]["dither"] == 0
    first = value["frames"][0]
    assert first["w"] == 32 and first["h"] == 24 and first["cx"] == 16 and first["fl_x"] == pytest.approx(first["fl_y"])
    np.testing.assert_allclose(first["transform_matrix"], np.array(shots[0].matrix_world), atol=1e-6)
    train, test = (read_dataset(tmp_path / "set", split) for split in ("train", "test"))
    assert [len(train.views), len(test.views)] == [4, 1]
    np.testing.assert_allclose(train.box.size, [2, 2, 2])
    assert test.cameras[0].position[2] == pytest.approx(6)


@pytest.mark.hard_case(1, 2)
@pytest.mark.parametrize(
    "size, percentage, aspect", [((333, 77), 37, (1.0, 1.0)), ((77, 333), 41, (1.0, 1.0)), ((120, 90), 100, (1.0, 1.7))]
)
def test_a_spot_is_rendered_where_the_camera_says(scene, tmp_path, size, percentage, aspect):
    """The renderer rounds resolutions that the percentage does not divide, and the projection must agree with it."""
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *size, percentage
    render.pixel_aspect_x, render.pixel_aspect_y = aspect
    scene.cycles.samples = 64
    camera = add_camera("Shifted", (0.3, -0.2, 6), shift_x=0.05, shift_y=-0.03)
    camera.rotation_euler = Euler((0.05, 0.1, 0.2))
    spot = add_plane(size=0.25, location=(0.2, 0.1, 0.0), emission=1.0)
    spot.rotation_euler = camera.rotation_euler
    bpy.context.view_layer.update()
    render_dataset(scene, [camera], tmp_path / "set", CaptureSettings(test_every=0))
    alpha = read_image(tmp_path / "set" / "train" / "r_0.png")[..., 3].astype(float)
    rows, columns = np.mgrid[: alpha.shape[0], : alpha.shape[1]] + 0.5
    centre = [(alpha * columns).sum() / alpha.sum(), (alpha * rows).sum() / alpha.sum()]
    expected, _ = camera_from_blender(camera, scene, evaluated(scene)).project(np.array([spot.location]))
    np.testing.assert_allclose(centre, expected[0], atol=0.06)


def test_the_rig_renders_from_where_it_says(scene, tmp_path):
    add_plane(size=0.5)
    box = Box.axis_aligned([-0.3, -0.3, -0.3], [0.3, 0.3, 0.3])
    shots = rig_cameras(box, RigSettings(count=3), 32, 24)
    before = state(scene)
    render_dataset(scene, shots, tmp_path / "set", CaptureSettings(test_every=0), box)
    assert state(scene) == before
    dataset = read_dataset(tmp_path / "set")
    assert len(dataset.views) == 3 and not (tmp_path / "set" / "transforms_test.json").exists()
    for index, camera in enumerate(dataset.cameras):
        assert camera.focal == pytest.approx(shots[index].focal)
        alpha = dataset.read(index)[..., 3].astype(float)
        rows, columns = np.mgrid[:24, :32] + 0.5
        assert (alpha * columns).sum() / alpha.sum() == pytest.approx(16, abs=0.7)
        assert (alpha * rows).sum() / alpha.sum() == pytest.approx(12, abs=0.7)


def stop_after(views):
    """A `Progress` that raises Cancelled after a number of views."""

    def stop(fraction: float, message: str) -> None:
        if message.startswith(f"View {views + 1} "):
            raise Cancelled("enough")

    return stop


def refuse_all(fraction: float, message: str) -> None:
    raise AssertionError(f"nothing was left to render, and yet: {message}")


def test_stopping_leaves_the_scene_as_it_was_and_keeps_the_views(scene, odd, tmp_path):
    """The views so far are a dataset; the next rendering adds the rest, and the result equals an uninterrupted one."""
    add_plane()
    shots = [add_camera(f"Camera {index}", (0, 0, 4 + index)) for index in range(4)]
    render_dataset(scene, shots, tmp_path / "whole", CaptureSettings(test_every=2))
    before = state(scene)
    with pytest.raises(Cancelled):
        render_dataset(scene, shots, tmp_path / "set", CaptureSettings(test_every=2), progress=stop_after(3))
    assert state(scene) == before
    assert [path.name for path in tmp_path.iterdir() if path.name != "whole"] == ["set.unfinished"]
    assert views_rendered(tmp_path / "set") == (3, 4)
    assert len(read_dataset(unfinished(tmp_path / "set"), "train").views) == 2
    assert len(read_dataset(unfinished(tmp_path / "set"), "test").views) == 1
    result = render_dataset(scene, shots, tmp_path / "set", CaptureSettings(test_every=2))
    assert result["kept"] == 3 and views_rendered(tmp_path / "set") == (0, 0)
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set", "whole"]


def test_a_rendering_that_is_not_the_same_or_not_wanted_begins_anew(scene, tmp_path):
    add_plane()
    shots = [add_camera(f"Camera {index}", (0, 0, 4 + index)) for index in range(3)]
    folder = tmp_path / "set"
    for change in ("resolution", "pose", "frame", "samples", "resume"):
        with pytest.raises(Cancelled):
            render_dataset(scene, shots, folder, resume=False, progress=stop_after(2))
        if change == "resolution":
            scene.render.resolution_x += 2
        elif change == "pose":
            shots[2].location.x += 0.1
            bpy.context.view_layer.update()
        elif change == "frame":
            scene.frame_set(7)
        elif change == "samples":
            scene.cycles.samples = 2
        assert "kept" not in render_dataset(scene, shots, folder, resume=change != "resume"), change
    scene.frame_set(1)


def test_a_rendering_that_was_stopped_at_its_very_end_needs_no_view(scene, tmp_path, monkeypatch):
    add_plane()
    shots = [add_camera(f"Camera {index}", (0, 0, 4 + index)) for index in range(2)]

    def full(path):
        raise SnergError("The disk is full.")

    with monkeypatch.context() as patch, pytest.raises(SnergError, match="full"):
        patch.setattr(capture, "new_folder", full)
        render_dataset(scene, shots, tmp_path / "set")
    assert render_dataset(scene, shots, tmp_path / "set", progress=refuse_all)["kept"] == 2
    assert len(read_dataset(tmp_path / "set").views) == 2


def test_the_dataset_before_stays_until_the_new_one_is_whole(scene, tmp_path):
    add_plane()
    shots = [add_camera(f"Camera {index}", (0, 0, 4 + index)) for index in range(3)]
    render_dataset(scene, shots, tmp_path / "set")
    before = contents(tmp_path / "set")
    scene.render.resolution_x += 2
    with pytest.raises(Cancelled):
        render_dataset(scene, shots, tmp_path / "set", progress=stop_after(2))
    assert contents(tmp_path / "set") == before


def test_a_folder_of_the_artists_beside_the_dataset_is_left_alone(scene, tmp_path):
    theirs = unfinished(tmp_path / "set")
    theirs.mkdir()
    (theirs / "diary.txt").write_text("mine")
    with pytest.raises(SnergError, match="other files"):
        render_dataset(scene, [add_camera()], tmp_path / "set")
    assert (theirs / "diary.txt").read_text() == "mine"


def test_a_camera_that_cannot_be_used_stops_it_before_anything_is_rendered(scene, tmp_path):
    shots = [add_camera("Fine"), add_camera("Round", type="PANO")]
    before = state(scene)
    with pytest.raises(SnergError, match="'Round' is pano"):
        render_dataset(scene, shots, tmp_path / "set")
    with pytest.raises(SnergError, match="no camera"):
        render_dataset(scene, [], tmp_path / "set")
    assert state(scene) == before and list(tmp_path.iterdir()) == []


def test_a_folder_with_other_files_is_left_alone(scene, tmp_path):
    (tmp_path / "diary.txt").write_text("mine")
    with pytest.raises(SnergError, match="other files"):
        render_dataset(scene, [add_camera()], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["diary.txt"]


def test_every_nth_view_is_held_out():
    assert split_names(5, 2) == ["train/r_0", "test/r_0", "train/r_1", "test/r_1", "train/r_2"]
    assert split_names(3, 0) == ["train/r_0", "train/r_1", "train/r_2"]
    assert sum(name.startswith("test") for name in split_names(68, 8)) == 8


def test_the_spherical_field_of_view_is_blenders(scene):
    camera = camera_from_blender(add_camera(angle=math.radians(60)), scene, evaluated(scene))
    assert camera.focal[0] == pytest.approx(16 / math.tan(math.radians(30)), rel=1e-5)
