"""Pictures and poses agree, whatever hides, moves or aims a camera; what a dataset cannot show is refused or said in one sentence."""

from __future__ import annotations

import json
import math
from typing import Any

import bpy
import numpy as np
import pytest
from mathutils import Vector
from stage import add_camera, add_plane

from snerg.core.data.readers.camera_files import read_cameras
from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box
from snerg.core.io.images import read_image
from snerg.operators.render_dataset import chosen_shots
from snerg.snerg_addon.bridge import add_box
from snerg.snerg_addon.capture import render_dataset, unfinished
from snerg.snerg_addon.capture_scene import CaptureSettings
from snerg.snerg_addon.render_evaluation import evaluated_box, evaluated_cameras
from snerg.snerg_addon.shots import Moment

SPOT = np.array([0.3, 0.2, 0.0])
ALL = CaptureSettings(test_every=0)


@pytest.fixture
def spot(scene):
    """A glowing square at SPOT, which faces upward."""
    scene.cycles.samples = 8
    return add_plane(size=0.5, location=tuple(SPOT))


def aimed(name: str = "Camera", at: Any = (1, -2, 6), **settings: Any) -> Any:
    """A camera that looks at the origin."""
    camera = add_camera(name, at, **settings)
    camera.rotation_euler = (-Vector(at)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.view_layer.update()
    return camera


def cameras_of(folder) -> Any:
    """The recorded cameras of the training views."""
    return read_cameras(folder / "transforms_train.json")


def picture_of(folder, index=0) -> np.ndarray:
    """The picture [H, W, 4] of a training view."""
    return read_image(folder / "train" / f"r_{index}.png")


def pixels_off(folder, where=SPOT, index=0) -> float:
    """How far, in pixels, a view shows the glowing square from where its recorded pose puts it."""
    alpha = picture_of(folder, index)[..., 3].astype(float)
    rows, columns = np.mgrid[: alpha.shape[0], : alpha.shape[1]] + 0.5
    shown = [(alpha * columns).sum() / alpha.sum(), (alpha * rows).sum() / alpha.sum()]
    return math.dist(shown, cameras_of(folder)[index].project(np.array([where]))[0][0])


def in_collection(thing, name="Cameras"):
    collection = bpy.data.collections.new(name)
    bpy.context.scene.collection.children.link(collection)
    bpy.context.scene.collection.objects.unlink(thing)
    collection.objects.link(thing)
    return collection


def exclude(camera):
    in_collection(camera)
    bpy.context.view_layer.layer_collection.children["Cameras"].exclude = True


def hide_collection(camera):
    in_collection(camera).hide_viewport = True


def hide(camera):
    camera.hide_viewport = camera.hide_render = True


def aim(camera):
    target = bpy.data.objects.new("Target", None)
    bpy.context.scene.collection.objects.link(target)
    camera.rotation_euler = (0, 0, 0)
    camera.constraints.new("TRACK_TO").target = target
    camera.hide_viewport = True


def move_without_key(camera):
    camera.keyframe_insert("location", frame=1)
    bpy.context.view_layer.update()
    camera.location.x += 0.5


def zoom_without_key(camera):
    camera.data.keyframe_insert("lens", frame=1)
    bpy.context.view_layer.update()
    camera.data.lens = 35


def zoom_hidden(camera):
    zoom_without_key(camera)
    camera.hide_viewport = camera.hide_render = True


def scaled_parent(camera):
    parent = bpy.data.objects.new("Parent", None)
    bpy.context.scene.collection.objects.link(parent)
    parent.scale = (2, 2, 2)
    camera.parent, camera.matrix_parent_inverse = parent, parent.matrix_world.inverted()


def bound_marker(camera):
    marker = bpy.context.scene.timeline_markers.new("Cut", frame=1)
    marker.camera = add_camera("Other", (50, 0, 0))


WAYS = (exclude, hide_collection, hide, aim, move_without_key, zoom_without_key, zoom_hidden, scaled_parent, bound_marker)


@pytest.mark.parametrize("way", WAYS)
def test_a_picture_is_taken_from_its_pose(scene, spot, tmp_path, way):
    camera = aimed()
    way(camera)
    place, lens = camera.location.copy(), camera.data.lens
    render_dataset(scene, [camera], tmp_path / "set", ALL)
    scene.timeline_markers.clear()
    assert pixels_off(tmp_path / "set") < 0.5
    assert camera.location == place and camera.data.lens == lens, "a change without a key is still there"


def test_a_handler_that_places_the_camera_is_asked(scene, spot, tmp_path):
    camera = aimed()

    def put(_scene, _depsgraph=None):
        camera.location.x = 0.5

    bpy.app.handlers.frame_change_pre.append(put)
    try:
        render_dataset(scene, [camera], tmp_path / "set", ALL)
    finally:
        bpy.app.handlers.frame_change_pre.remove(put)
    assert pixels_off(tmp_path / "set") < 0.5
    assert cameras_of(tmp_path / "set")[0].position[0] == pytest.approx(0.5)


def test_the_frame_and_its_part_are_the_scenes(scene, spot, tmp_path):
    camera = aimed()
    camera.keyframe_insert("location", frame=1)
    camera.location.x += 8
    camera.keyframe_insert("location", frame=9)
    for curve in camera.animation_data.action.layers[0].strips[0].channelbags[0].fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"
    scene.frame_set(1, subframe=0.5)
    try:
        (found,) = evaluated_cameras(scene, [camera])
        assert found.position[0] == pytest.approx(1.5, abs=1e-5)
        (later,) = evaluated_cameras(scene, [camera], frame=5)
        assert later.position[0] == pytest.approx(5, abs=1e-5)
        assert (scene.frame_current, scene.frame_subframe) == (1, 0.5)
    finally:
        scene.frame_set(1)


@pytest.mark.parametrize("scale", [0.01, 1.0, 1000.0])
def test_the_rig_shows_scenes_of_any_size(scene, tmp_path, scale):
    add_plane(size=0.5 * scale)
    bpy.ops.snerg.add_box()
    scene.snerg.cameras, scene.snerg.rig_count = "RIG", 2
    render_dataset(scene, chosen_shots(bpy.context), tmp_path / "set", ALL)
    assert pixels_off(tmp_path / "set", np.zeros(3)) < 1


def test_a_clip_plane_is_a_plane(scene, tmp_path):
    """A square that the clip end lies behind only along the axis: its corners are farther from the camera, and still show."""
    scene.cycles.samples = 4
    add_plane(size=6.0)
    camera = add_camera(location=(0, 0, 5), clip_end=5.2)
    render_dataset(scene, [camera], tmp_path / "set", ALL)
    (view,) = cameras_of(tmp_path / "set")
    assert (view.near, view.far) == pytest.approx((0.1, 5.2))
    alpha = picture_of(tmp_path / "set")[..., 3]
    assert (alpha == 255).all(), "the corner is 5.5 away"


def test_depth_of_field_is_left_out_and_said(scene, spot, tmp_path):
    camera = aimed()
    camera.data.dof.use_dof, camera.data.dof.aperture_fstop, camera.data.dof.focus_distance = True, 0.01, 0.5
    result = render_dataset(scene, [camera], tmp_path / "set", ALL)
    assert "depth of field of 'Camera'" in result["warnings"][0]
    assert picture_of(tmp_path / "set")[..., 3].max() == 255
    assert camera.data.dof.use_dof


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        ({"clip_end": 1.0}, "clip end"),
        ({"clip_start": 50.0}, "clip start"),
        ({"at": (0, 0, 5), "turned": (math.pi, 0, 0)}, "behind the cameras"),
        ({"at": (0, 0, 5), "turned": (1.2, 0, 0)}, "no object is in front"),
        ({"layer": "hides"}, "nothing on the view layer 'ViewLayer' renders"),
    ],
)
def test_an_empty_dataset_is_an_error_that_says_why(scene, tmp_path, camera, said):
    plane = add_plane()
    made = add_camera(location=camera.get("at", (0, 0, 5)))
    made.rotation_euler = camera.get("turned", (0, 0, 0))
    for name in ("clip_start", "clip_end"):
        if name in camera:
            setattr(made.data, name, camera[name])
    plane.hide_render = camera.get("layer") == "hides"
    bpy.context.view_layer.update()
    with pytest.raises(SnergError, match=f"Every picture is empty: .*{said}"):
        render_dataset(scene, [made], tmp_path / "set", ALL)
    assert not unfinished(tmp_path / "set").exists() and not (tmp_path / "set").exists()


def test_views_that_show_nothing_are_named(scene, spot, tmp_path):
    away = add_camera("Away", (0, 0, 5))
    away.rotation_euler = (math.pi, 0, 0)
    bpy.context.view_layer.update()
    result = render_dataset(scene, [aimed("Fine"), away], tmp_path / "set", ALL)
    assert result["warnings"] == ["1 of 2 pictures show nothing: 'Away'."]


def test_a_sheared_camera_is_refused(scene, spot, tmp_path):
    parent = bpy.data.objects.new("Parent", None)
    scene.collection.objects.link(parent)
    parent.scale = (3, 1, 1)
    camera = aimed()
    camera.parent = parent
    with pytest.raises(SnergError, match="'Camera' is sheared"):
        render_dataset(scene, [camera], tmp_path / "set", ALL)


@pytest.mark.parametrize("name", ["{TDA}", "{scene_name}", "back\\slash", "..dots..", "#### %d"])
def test_names_are_not_file_names(scene, spot, tmp_path, name):
    """The artist's names of a folder, a camera and a scene; nothing is written elsewhere."""
    camera = aimed(f"a/b {name}")
    old, scene.name = scene.name, f"we/ird {name}"
    try:
        render_dataset(scene, [camera], tmp_path / name / "set", ALL)
    finally:
        scene.name = old
    assert pixels_off(tmp_path / name / "set") < 0.5
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == [".snerg", "r_0.exr", "r_0.png", "transforms_train.json"]


@pytest.fixture
def unkeyed_again(scene):
    yield
    scene.animation_data_clear()
    scene.view_settings.view_transform, scene.view_settings.look, scene.view_settings.exposure = "Standard", "None", 0
    scene.render.film_transparent = False


@pytest.mark.parametrize("own", [False, True])
def test_the_record_is_true_where_settings_are_keyed(scene, spot, tmp_path, unkeyed_again, own):
    scene.view_settings.view_transform = "AgX" if own else "Standard"
    scene.view_settings.exposure, scene.render.film_transparent = 1, False
    scene.keyframe_insert("view_settings.exposure", frame=1)
    scene.keyframe_insert("render.film_transparent", frame=1)
    scene.view_settings.exposure = 3  # without a key
    actions = len(bpy.data.actions)
    camera = scene.camera = aimed()
    render_dataset(scene, [camera], tmp_path / "set", CaptureSettings(0, scene_look=own))
    recorded = json.loads((tmp_path / "set" / "transforms_train.json").read_text())["snerg_render"]
    assert recorded["film_transparent"] is True
    assert (recorded["view_transform"], recorded["exposure"]) == (("AgX", 1) if own else ("Standard", 0))
    pixels = picture_of(tmp_path / "set")
    assert (pixels[0, 0] == 0).all() and len(bpy.data.actions) == actions
    own_render = tmp_path / "own.png"
    scene.view_settings.exposure, scene.render.filepath = recorded["exposure"], str(own_render)
    scene.render.dither_intensity, scene.render.image_settings.file_format = 0, "PNG"
    scene.view_settings.view_transform = recorded["view_transform"]
    scene.animation_data_clear()
    bpy.ops.render.render(write_still=True)
    solid = pixels[..., 3] == 255
    assert solid.sum() >= 4
    assert np.abs(pixels[solid][:, :3].astype(int) - read_image(own_render)[solid][:, :3].astype(int)).max() <= 2


@pytest.fixture
def two_layers(scene):
    """The left square is on the first view layer, the right one on the second."""
    for name, x in (("Left", -0.5), ("Right", 0.5)):
        in_collection(add_plane(size=0.4, location=(x, 0, 0)), name)
    other = scene.view_layers.new("Other")
    scene.view_layers[0].layer_collection.children["Right"].exclude = True
    other.layer_collection.children["Left"].exclude = True
    yield
    scene.view_layers.remove(other)


def test_one_view_layer_is_rendered_and_the_others_are_named(scene, two_layers, tmp_path):
    camera = add_camera(location=(0, 0, 4))
    first = render_dataset(scene, [camera], tmp_path / "first", ALL)
    assert first["warnings"] == ["The dataset shows the view layer 'ViewLayer' and not 'Other'; choose another under View Layer."]
    assert pixels_off(tmp_path / "first", [-0.5, 0, 0]) < 0.5
    assert "warnings" not in render_dataset(scene, [camera], tmp_path / "other", CaptureSettings(0, view_layer="Other"))
    assert pixels_off(tmp_path / "other", [0.5, 0, 0]) < 0.5
    with pytest.raises(SnergError, match=r"no view layer 'None such'.*ViewLayer, Other"):
        render_dataset(scene, [camera], tmp_path / "none", CaptureSettings(0, view_layer="None such"))


@pytest.mark.parametrize("hidden", ["hide_viewport", "hide_render", "collection"])
def test_a_hidden_box_is_where_it_is(scene, hidden):
    box = bpy.data.objects.new("Box", None)
    scene.collection.objects.link(box)
    box.location, box.scale = (5, 6, 7), (2, 1, 1)
    if hidden == "collection":
        exclude(box)
    else:
        setattr(box, hidden, True)
    found = evaluated_box(scene, box)
    np.testing.assert_allclose(found.box_to_world[:3, 3], (5, 6, 7))
    np.testing.assert_allclose(found.size, (4, 2, 2))


def added_box(scene) -> tuple[np.ndarray, np.ndarray]:
    """(lowest, highest) corner of the box that Add Box makes, and Fit Box to Objects where there is one, without its margin."""
    fit = bpy.ops.snerg.fit_box if scene.snerg.box else bpy.ops.snerg.add_box
    assert fit() == {"FINISHED"}
    box = evaluated_box(scene, scene.snerg.box)
    centre, half = box.box_to_world[:3, 3], box.size / 2 / 1.05
    return centre - half, centre + half


def test_add_box_fits_a_collection_instance(scene):
    asset = bpy.data.collections.new("Asset")
    plane = add_plane(size=2.0)
    scene.collection.objects.unlink(plane)
    asset.objects.link(plane)
    instance = bpy.data.objects.new("Instance", None)
    instance.instance_type, instance.instance_collection, instance.location = "COLLECTION", asset, (5, 0, 0)
    scene.collection.objects.link(instance)
    low, high = added_box(scene)
    np.testing.assert_allclose([low[:2], high[:2]], [[4, -1], [6, 1]], atol=1e-5)


def test_add_box_leaves_out_what_does_not_render_and_takes_what_the_viewport_hides(scene):
    add_plane(size=2.0)
    add_plane(size=2.0, location=(3, 0, 0)).hide_viewport = True
    add_plane(size=2.0, location=(50, 0, 0)).hide_render = True
    in_collection(add_plane(size=2.0, location=(100, 0, 0)), "Helpers").hide_render = True
    low, high = added_box(scene)
    np.testing.assert_allclose([low[:2], high[:2]], [[-1, -1], [4, 1]], atol=1e-5)


def scattered(source) -> Any:
    """An object whose geometry nodes put instances of another at x = -2 and x = 2."""
    points = bpy.data.meshes.new("points")
    points.from_pydata([(-2, 0, 0), (2, 0, 0)], [], [])
    tree = bpy.data.node_groups.new("Scatter", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "NodeGroupOutput", "GeometryNodeInstanceOnPoints", "GeometryNodeObjectInfo")
    start, end, scatter, info = (tree.nodes.new(kind) for kind in kinds)
    info.inputs[0].default_value = source
    tree.links.new(start.outputs[0], scatter.inputs[0])
    tree.links.new(info.outputs["Geometry"], scatter.inputs["Instance"])
    tree.links.new(scatter.outputs[0], end.inputs[0])
    made = bpy.data.objects.new("Scatter", points)
    bpy.context.scene.collection.objects.link(made)
    made.modifiers.new("Scatter", "NODES").node_group = tree
    bpy.context.view_layer.update()
    return made


def test_add_box_fits_instances_of_geometry_nodes(scene):
    source = add_plane(size=2.0)
    source.hide_render = True
    made = scattered(source)
    low, high = added_box(scene)
    np.testing.assert_allclose([low[:2], high[:2]], [[-3, -1], [3, 1]], atol=1e-5)
    add_plane(size=2.0, location=(20, 0, 0))
    for thing in scene.objects:
        thing.select_set(thing == made)
    low, high = added_box(scene)
    np.testing.assert_allclose([low[:2], high[:2]], [[-3, -1], [3, 1]], atol=1e-5)


def moving_camera():
    camera = aimed()
    camera.constraints.new("TRACK_TO").target = add_box_target()
    camera.keyframe_insert("location", frame=1)
    camera.location.x -= 2
    camera.keyframe_insert("location", frame=9)
    return camera


def add_box_target():
    target = bpy.data.objects.new("Target", None)
    bpy.context.scene.collection.objects.link(target)
    return target


def test_one_camera_over_frames(scene, spot, tmp_path):
    moving_camera()
    scene.snerg.over_frames, scene.snerg.frame_step, scene.frame_start, scene.frame_end = True, 4, 1, 9
    shots = chosen_shots(bpy.context)
    assert [shot.frame for shot in shots] == [1, 5, 9]
    result = render_dataset(scene, shots, tmp_path / "set", ALL)
    assert result["train"] == 3 and "warnings" not in result
    places = [camera.position[0] for camera in cameras_of(tmp_path / "set")]
    assert places == pytest.approx([1, 0, -1], abs=1e-4)
    assert max(pixels_off(tmp_path / "set", index=index) for index in range(3)) < 0.5


def moved(spot):
    spot.keyframe_insert("location", frame=1)
    spot.location.z = 0.5
    spot.keyframe_insert("location", frame=9)


def reshaped(spot):
    spot.shape_key_add(name="Basis")
    key = spot.shape_key_add(name="Tall")
    key.data[0].co.z = 0.7
    for value, frame in ((0.0, 1), (1.0, 9)):
        key.value = value
        key.keyframe_insert("value", frame=frame)


@pytest.mark.parametrize("change", [moved, reshaped])
def test_an_object_that_moves_or_changes_while_frames_pass_is_named(scene, spot, tmp_path, change):
    camera = moving_camera()
    change(spot)
    result = render_dataset(scene, [Moment(camera, frame) for frame in (1, 9)], tmp_path / "set", ALL)
    assert "'Plane' moves or changes while the frames pass" in result["warnings"][0]


def test_markers_choose_the_active_camera_of_a_frame(scene):
    scene.camera = first = aimed("First")
    second = aimed("Second")
    for frame, camera in ((1, first), (4, second)):
        scene.timeline_markers.new("Cut", frame=frame).camera = camera
    scene.snerg.cameras, scene.snerg.over_frames, scene.frame_start, scene.frame_end = "ACTIVE", True, 3, 4
    try:
        assert [(shot.camera, shot.frame) for shot in chosen_shots(bpy.context)] == [(first, 3), (second, 4)]
    finally:
        scene.timeline_markers.clear()


def test_test_cameras_are_chosen(scene, spot, tmp_path):
    held_out = in_collection(aimed("B", (-1, -2, 6)), "Test")
    aimed("A")
    scene.snerg.test_cameras, scene.snerg.test_every = held_out, 2
    bpy.ops.snerg.render_dataset()
    folder = tmp_path / "project" / "dataset"
    (train,), (test,) = (read_cameras(folder / f"transforms_{split}.json") for split in ("train", "test"))
    assert (train.position[0], test.position[0]) == pytest.approx((1, -1))
    held_out.objects.link(bpy.data.objects["A"])
    with pytest.raises(RuntimeError, match="All cameras are test cameras"):
        bpy.ops.snerg.render_dataset()


def test_views_that_contradict_each_other_are_said(scene, tmp_path):
    """A square that a handler turns to each camera, as a billboard."""
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    square = add_plane(size=2.0)
    cameras = [add_camera("A", (0, -5, 0)), add_camera("B", (5, 0, 0))]
    for camera in cameras:
        camera.rotation_euler = (-camera.location).to_track_quat("-Z", "Y").to_euler()

    def face(scene, _depsgraph=None):
        if scene.camera is not None:
            square.rotation_euler = scene.camera.location.to_track_quat("Z", "Y").to_euler()

    bpy.app.handlers.frame_change_pre.append(face)
    try:
        said = render_dataset(scene, cameras, tmp_path / "set", ALL)["warnings"]
    finally:
        bpy.app.handlers.frame_change_pre.remove(face)
    assert len(said) == 1 and "'A' and 'B' contradict each other" in said[0]


def test_views_of_a_still_scene_do_not_contradict_each_other(scene, tmp_path):
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    for height in range(4):
        add_plane(size=2.0 - 0.4 * height, location=(0.1 * height, 0, 0.3 * height))
    cameras = [aimed("A", (0, -3, 5)), aimed("B", (3, 0, 4)), aimed("C", (-2, 2, 5))]
    assert "warnings" not in render_dataset(scene, cameras, tmp_path / "set", ALL)


def test_a_box_of_the_scene_is_recorded_though_it_is_hidden(scene, spot, tmp_path):
    box = add_box(Box.axis_aligned([-1, -2, -3], [1, 2, 3]), scene)
    box.hide_viewport = True
    aimed()
    bpy.ops.snerg.render_dataset()
    recorded = json.loads((tmp_path / "project" / "dataset" / "transforms_train.json").read_text())["snerg_box"]
    np.testing.assert_allclose(recorded["size"], [2, 4, 6], atol=1e-6)
