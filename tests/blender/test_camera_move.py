"""The camera's move over the frame range: as Blender's own renders would look, whatever moves the camera."""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np
import pytest
from mathutils import Vector
from stage import add_camera

from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.camera_path import CameraPath, path_bytes
from snerg.core.geometry.thin_path import TOLERANCE
from snerg.snerg_addon import camera_move as camera_move_module
from snerg.snerg_addon import render_evaluation
from snerg.snerg_addon.bridge import camera_from_blender
from snerg.snerg_addon.camera_move import SLICE_SECONDS, camera_move, camera_move_steps, is_animated, may_move
from snerg.snerg_addon.shots import active_at

BOX = Box.axis_aligned([-0.8] * 3, [0.8] * 3)


@pytest.fixture
def stage(scene: Any) -> Any:
    """A scene of 40 frames, at one that is not among them, with a camera at rest."""
    scene.frame_start, scene.frame_end, scene.render.fps = 11, 50, 25
    scene.render.resolution_x, scene.render.resolution_y = 320, 240
    scene.camera = add_camera("Camera", (0.0, -5.0, 1.0))
    scene.camera.rotation_euler = (-scene.camera.location).to_track_quat("-Z", "Y").to_euler()
    scene.frame_set(7)
    yield scene
    scene.timeline_markers.clear()
    scene.frame_start, scene.frame_end, scene.render.fps = 1, 250, 24
    scene.frame_set(1)


def keyed(thing: Any, path: str, *keys: tuple[int, Any]) -> None:
    for frame, value in keys:
        setattr(thing, path, value)
        thing.keyframe_insert(path, frame=frame)


def turntable(scene: Any) -> None:
    """A parent that turns, scaled: the camera inherits its pose."""
    parent = bpy.data.objects.new("Turntable", None)
    scene.collection.objects.link(parent)
    parent.scale = (2.0, 2.0, 2.0)
    scene.camera.parent, scene.camera.location = parent, (0.0, -2.5, 0.5)
    keyed(parent, "rotation_euler", (11, (0, 0, 0)), (51, (0, 0, 2 * math.pi)))


def even_turntable(scene: Any) -> None:
    """The same at an even speed, by a driver: a turn needs only so many keys that each is less than half a turn."""
    turntable(scene)
    parent = scene.camera.parent
    parent.animation_data_clear()
    parent.driver_add("rotation_euler", 2).driver.expression = "(frame - 11) * pi / 20"


def on_a_curve(scene: Any) -> None:
    """It follows a curve and tracks an object."""
    curve = bpy.data.curves.new("Rail", "CURVE")
    curve.dimensions, curve.path_duration = "3D", 40
    spline = curve.splines.new("BEZIER")
    spline.bezier_points.add(2)
    for point, place in zip(spline.bezier_points, ((4, -4, 1), (5, 1, 2.5), (-1, 4, 0.5)), strict=True):
        point.co, point.handle_left_type, point.handle_right_type = place, "AUTO", "AUTO"
    rail, target = bpy.data.objects.new("Rail", curve), bpy.data.objects.new("Target", None)
    for thing in (rail, target):
        scene.collection.objects.link(thing)
    target.location, scene.camera.location = (0.1, 0.2, 0.0), (0.0, 0.0, 0.0)
    follow = scene.camera.constraints.new("FOLLOW_PATH")
    follow.target, follow.use_fixed_location = rail, True
    for frame, offset in ((11, 0.0), (50, 0.9)):
        follow.offset_factor = offset
        follow.keyframe_insert("offset_factor", frame=frame)
    track = scene.camera.constraints.new("TRACK_TO")
    track.target, track.track_axis, track.up_axis = target, "TRACK_NEGATIVE_Z", "UP_Y"


def driven(scene: Any) -> None:
    """A driver moves it by the frame's number."""
    driver = scene.camera.driver_add("location", 0).driver
    driver.expression = "frame * frame / 1000"


def zoomed(scene: Any) -> None:
    """Its lens and its shift have keys."""
    keyed(scene.camera.data, "lens", (11, 30.0), (50, 90.0))
    keyed(scene.camera.data, "shift_x", (11, 0.0), (30, 0.2))


def flat(scene: Any) -> None:
    """An orthographic camera whose scale and place have keys."""
    scene.camera.data.type = "ORTHO"
    keyed(scene.camera.data, "ortho_scale", (11, 2.0), (50, 6.0))
    keyed(scene.camera, "location", (11, (0, -5, 1)), (30, (1, -5, 1)), (50, (1, -4, 3)))


def handheld(scene: Any) -> None:
    """Noise, which needs many keys."""
    keyed(
        scene.camera,
        "rotation_euler",
        *[(f, Vector((1.37, 0, 0)) + 0.03 * Vector((math.sin(3 * f), 0, math.cos(5 * f)))) for f in range(11, 52, 2)],
    )


def truth(scene: Any, frame: int) -> Camera:
    """Where Blender's own timeline puts the active camera."""
    scene.frame_set(frame)
    return camera_from_blender(scene.camera, scene, bpy.context.evaluated_depsgraph_get())


def worst_pixels(scene: Any, path: CameraPath, other: Any = None) -> float:
    points = np.random.default_rng(2).uniform(-0.8, 0.8, (300, 3))
    worst = 0.0
    for frame in path.frames:
        expected = truth(scene, frame)
        found = path.camera_at(frame)
        assert found.name == expected.name
        seen = expected.shows(points)
        worst = max(worst, float(np.abs(expected.project(points)[0] - found.project(points)[0])[seen].max(initial=0)))
        assert found.near == pytest.approx(expected.near) and found.far == pytest.approx(expected.far)
    return worst


@pytest.mark.parametrize("move", [turntable, even_turntable, on_a_curve, driven, zoomed, flat, handheld])
def test_every_frame_is_where_blender_puts_it(stage: Any, move: Any) -> None:
    move(stage)
    assert may_move(stage)
    stage.frame_set(7)
    before = [stage.camera.matrix_world.copy(), stage.frame_current, stage.camera.data.lens]
    stage.camera.location.z += 0.0
    path = camera_move(stage, BOX)
    assert [stage.camera.matrix_world, stage.frame_current, stage.camera.data.lens] == before, "the artist's scene stays as it is"
    assert (path.start, path.end, path.fps) == (11, 50, 25.0) and path.moves
    assert worst_pixels(stage, path) < TOLERANCE
    assert path.shots[-1].frames[-1] == 51, "the frame after the last, for loops"
    assert len(path.shots) == 1 and path.keys <= {even_turntable: 6, driven: 3, handheld: 30}.get(move, 10)


def test_a_move_in_slices_is_the_same(stage: Any) -> None:
    """Between two of them, and where somebody stops, the scene is the artist's own; a simulation is evaluated in one."""
    turntable(stage)
    stage.frame_end = 25
    stage.camera.location.z = 1.25  # not keyed
    whole = camera_move(stage, BOX)
    steps, seen, path = camera_move_steps(stage, BOX, 1e-9), [], None
    while path is None:
        try:
            seen.append(next(steps))
        except StopIteration as end:
            path = end.value
        assert [scene.name for scene in bpy.data.scenes] == [stage.name] and stage.frame_current == 7
        assert stage.camera.location.z == 1.25 and not [thing for thing in bpy.data.objects if thing.name.startswith("SNeRG Rig")]
    assert path_bytes(path) == path_bytes(whole)
    fractions = [fraction for fraction, _ in seen]
    assert len(seen) > 3 and fractions == sorted(fractions) and seen[0][1].startswith("frame ") and seen[0][1].endswith(" of 16")
    stopped = camera_move_steps(stage, BOX, 1e-9)
    next(stopped)
    stopped.close()
    assert [scene.name for scene in bpy.data.scenes] == [stage.name] and stage.frame_current == 7
    body = bpy.data.objects.new("Body", bpy.data.meshes.new("Body"))
    stage.collection.objects.link(body)
    body.modifiers.new("Cloth", "CLOTH")
    assert next(camera_move_steps(stage, BOX, 1e-9))[1] == "frame 16 of 16"


class Clock:
    """A clock that stands still until somebody sets it forward."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def monotonic(self) -> float:
        return self.seconds

    def forward(self, seconds: float) -> float:
        self.seconds += seconds
        return 0.0


def test_a_slice_is_as_long_as_its_work(stage: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """At most SLICE_SECONDS and three frames: two that an evaluation begins with, and the one that it is in. What no camera depends on
    takes nothing."""
    turntable(stage)
    other = bpy.data.objects.new("Crowd", None)
    stage.collection.objects.link(other)
    clock, frame_seconds = Clock(), 0.04
    monkeypatch.setattr(camera_move_module, "time", clock)
    monkeypatch.setattr(render_evaluation, "time", clock)
    monkeypatch.setitem(bpy.app.driver_namespace, "slow", lambda: clock.forward(frame_seconds))
    monkeypatch.setitem(bpy.app.driver_namespace, "slower", lambda: clock.forward(10.0))
    stage.camera.driver_add("delta_location", 0).driver.expression = "slow() + 0 * frame"
    other.driver_add("location", 0).driver.expression = "slower() + 0 * frame"
    stage.frame_set(7)
    steps, slices = camera_move_steps(stage, BOX, SLICE_SECONDS), []
    for part in range(8):
        began = clock.seconds
        said = next(steps)
        slices.append(clock.seconds - began)
        assert said[1].startswith("frame ") and said[1] != f"frame {part + 1} of 41", "more than one frame a slice"
    steps.close()
    assert min(slices) > 0 and max(slices) < SLICE_SECONDS + 3 * frame_seconds
    stage.camera.driver_remove("delta_location", 0)
    bpy.data.objects.remove(other)


def test_a_camera_depends_on_what_is_hidden_and_elsewhere(stage: Any) -> None:
    """It follows the vertex of a mesh that a modifier of renders moves, in a collection that the view layer leaves out."""
    away = bpy.data.collections.new("Away")
    stage.collection.children.link(away)
    mesh = bpy.data.meshes.new("Sheet")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    sheet, control = bpy.data.objects.new("Sheet", mesh), bpy.data.objects.new("Control", None)
    for thing in (sheet, control):
        away.objects.link(thing)
    keyed(control, "location", (11, (0, 0, 0)), (51, (0, 0, 2)))
    sheet.vertex_groups.new(name="All").add([0, 1, 2], 1.0, "REPLACE")
    hook = sheet.modifiers.new("Hook", "HOOK")
    hook.object, hook.vertex_group = control, "All"
    bpy.context.view_layer.update()
    hook.matrix_inverse = control.matrix_world.inverted()
    stage.camera.location = (0, 0, 0)
    stage.camera.constraints.new("COPY_LOCATION").target = sheet
    stage.camera.constraints[0].subtarget = "All"
    stage.frame_set(7)
    assert worst_pixels(stage, camera_move(stage, BOX)) < TOLERANCE
    before = camera_move(stage, BOX)
    stage.view_layers[0].layer_collection.children["Away"].exclude = True
    sheet.hide_render = True
    after = camera_move(stage, BOX)
    assert path_bytes(after) == path_bytes(before)
    heights = [after.camera_at(frame).position[2] for frame in (11, 50)]
    assert heights[1] - heights[0] > 1.5


def test_markers_are_cuts(stage: Any) -> None:
    """The marker before the range chooses the first camera; one whose camera is hidden in renders is passed over."""
    turntable(stage)
    second, hidden = add_camera("Second", (3.0, -3.0, 3.0)), add_camera("Hidden", (1.0, 1.0, 9.0))
    hidden.hide_render = True
    first = stage.camera
    for frame, camera in ((5, first), (20, second), (30, hidden), (41, first)):
        stage.timeline_markers.new("Cut", frame=frame).camera = camera
    assert [active_at(stage, frame) for frame in (1, 11, 19, 20, 35, 41)] == [first, first, first, second, second, first]
    path = camera_move(stage, BOX)
    assert [(shot.cameras[0].name, shot.frames[0]) for shot in path.shots] == [("Camera", 11), ("Second", 20), ("Camera", 41)]
    assert path.shots[0].frames[-1] == 20, "it moves on until the cut"
    assert len(path.shots[1].frames) == 1 and path.camera_at(19.999).name == "Camera"
    assert worst_pixels(stage, path) < TOLERANCE


def test_a_camera_that_becomes_another_kind_is_cut(stage: Any) -> None:
    keyed(stage.camera.data, "type", (11, "PERSP"), (30, "ORTHO"))
    path = camera_move(stage, BOX)
    assert [(shot.cameras[0].projection, shot.frames[0]) for shot in path.shots] == [("perspective", 11), ("orthographic", 30)]


def test_what_stands_still_does_not_move(stage: Any) -> None:
    assert not may_move(stage) and not camera_move(stage, BOX).moves
    target = bpy.data.objects.new("Target", None)
    stage.collection.objects.link(target)
    stage.camera.constraints.new("TRACK_TO").target = target
    assert not may_move(stage)
    keyed(target, "location", (11, (0, 0, 0)), (50, (1, 0, 0)))
    assert may_move(stage) and is_animated(stage.camera) and camera_move(stage, BOX).moves
    stage.frame_end = stage.frame_start
    assert not may_move(stage)


def test_changes_without_a_key_stay(stage: Any) -> None:
    turntable(stage)
    stage.camera.location.x = 1.25  # not keyed
    camera_move(stage, BOX)
    assert stage.camera.location.x == 1.25 and [scene.name for scene in bpy.data.scenes] == [stage.name]


@pytest.mark.parametrize("case", ["none", "panorama"])
def test_a_move_that_cannot_be_shown_says_why(stage: Any, case: str) -> None:
    stage.render.engine = "CYCLES"
    if case == "none":
        stage.camera = None
    else:
        stage.camera.data.type = "PANO"
        stage.camera.data.panorama_type = "EQUIRECTANGULAR"
    with pytest.raises(SnergError, match="no active camera" if case == "none" else "a path needs perspective or orthographic"):
        camera_move(stage, BOX)


def test_without_a_box_all_between_the_clip_planes_is_shown_right(stage: Any) -> None:
    turntable(stage)
    stage.camera.data.clip_start, stage.camera.data.clip_end = 1.0, 20.0
    assert worst_pixels(stage, camera_move(stage, None)) < TOLERANCE
