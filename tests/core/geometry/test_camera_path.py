"""Camera paths: interpolation against rotations by SciPy's rules, files, and keys left out within a bound that projected points keep."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from scenes import looking
from snerg.core.errors import SnergError
from snerg.core.geometry import thin_path
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.camera_path import CameraPath, Shot, path_bytes
from snerg.core.geometry.camera_state import pixel_errors, state_of
from snerg.core.geometry.rotation import quaternion, rotation_matrix, slerp
from snerg.core.geometry.thin_path import TOLERANCE, looked_at, thinned

FAR = np.array([1e6, -2e6, 5e5])


def camera(pose: np.ndarray, **more: object) -> Camera:
    return replace(Camera(320, 200, (300.0, 300.0), (160.0, 100.0), pose, name="Fly", near=0.1, far=100.0), **more)


def over_the_pole(frames: np.ndarray, at: np.ndarray | float = 0.0) -> list[Camera]:
    """Round the scene across both poles, rolling, while the lens zooms and shifts."""
    made = []
    for u in frames / frames[-1]:
        turn = Rotation.from_euler("XYZ", [2 * math.pi * u, 0.3 * u, 1.5 * u])
        pose = np.eye(4)
        pose[:3, :3] = turn.as_matrix()
        pose[:3, 3] = pose[:3, 2] * (4 + u) + at
        made.append(camera(pose, focal=(300 * 2**u, 280 * 2**u), centre=(160 + 30 * u, 100 - 20 * u)))
    return made


def path_of(frames: np.ndarray, cameras: list[Camera]) -> CameraPath:
    return CameraPath((Shot(tuple(map(float, frames)), tuple(cameras)),), int(frames[0]), int(frames[-1]), 24.0)


def test_quaternions_are_those_of_scipy() -> None:
    turns = Rotation.random(300, random_state=3)
    turns = Rotation.concatenate([turns, Rotation.from_euler("xyz", np.eye(3) * 180, degrees=True), Rotation.identity(1)])
    for turn in turns:
        found = quaternion(turn.as_matrix())
        assert abs(abs(found @ turn.as_quat()) - 1) < 1e-14
        assert np.allclose(rotation_matrix(3 * found), turn.as_matrix(), atol=1e-14)
    for one, other in zip(turns[:50], turns[50:100], strict=True):
        parts = np.linspace(0, 1, 7)
        expected = Slerp([0, 1], Rotation.concatenate([one, other]))(parts)
        found = slerp(one.as_quat(), other.as_quat(), parts)
        assert np.allclose([rotation_matrix(q) for q in found], expected.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("at", [0.0, FAR], ids=["at the origin", "far from it"])
def test_between_keys(at: np.ndarray | float) -> None:
    frames = np.array([1.0, 9.0, 12.0])
    cameras = over_the_pole(frames, at)
    path = path_of(frames, cameras)
    found = path.camera_at(5.0)
    a, b = cameras[:2]
    turns = Rotation.from_matrix([a.camera_to_world[:3, :3], b.camera_to_world[:3, :3]])
    assert np.allclose(found.camera_to_world[:3, :3], Slerp([0, 1], turns)(0.5).as_matrix(), atol=1e-9)
    assert np.allclose(found.position, (a.position + b.position) / 2, rtol=0, atol=1e-9)
    assert np.allclose(found.focal, np.sqrt(np.array(a.focal) * b.focal)) and np.allclose(found.centre, (np.array(a.centre) + b.centre) / 2)
    for frame, there in ((-5.0, cameras[0]), (9.0, cameras[1]), (99.0, cameras[2])):
        assert np.allclose(path.camera_at(frame).camera_to_world, there.camera_to_world, rtol=0, atol=1e-9)


@pytest.mark.parametrize("at", [0.0, FAR], ids=["at the origin", "far from it"])
def test_around_a_point(at: np.ndarray | float) -> None:
    """A turn of 170 degrees with a key at each end stays on its circle, and comes nearer evenly."""
    ends = [Rotation.from_euler("xz", [70, angle], degrees=True) for angle in (0.0, 170.0)]
    cameras = []
    for turn, distance in zip(ends, (4.0, 3.0), strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.as_matrix(), distance * turn.as_matrix()[:, 2] + [0.5, 0, 0.2] + at
        cameras.append(camera(pose))
    shot = Shot((0.0, 10.0), tuple(cameras), (4.0, 3.0))
    for part in np.linspace(0, 1, 9):
        found = shot.camera_at(10 * part)
        assert np.allclose(found.position - (4 - part) * found.camera_to_world[:3, 2], np.array([0.5, 0, 0.2]) + at, rtol=0, atol=1e-8)


@pytest.fixture
def curve() -> np.ndarray:
    """Velocities of all kinds, a frame."""
    return np.random.default_rng(5).uniform(-0.1, 0.1, (2, 11)) * [1, 1, 1, 0.5, 0.5, 0.5, 0.2, 0.2, 20, 20, 1]


@pytest.mark.parametrize("at", [0.0, FAR], ids=["at the origin", "far from it"])
def test_along_a_curve(curve: np.ndarray, at: np.ndarray | float) -> None:
    """Each value is SciPy's cubic Hermite spline; the angular velocities are those with which the camera leaves and arrives."""
    frames = (2.0, 12.0)
    one, other = over_the_pole(np.array([0.0, 3.0, 9.0]), at)[:2]
    shot = Shot(frames, (one, other), (4.0, 3.0), (curve,))

    def spline(a: object, b: object, columns: slice | int) -> CubicHermiteSpline:
        return CubicHermiteSpline(frames, np.array([a, b]), curve[:, columns])

    targets = [c.position - d * c.camera_to_world[:3, 2] for c, d in ((one, 4.0), (other, 3.0))]
    target, distance = spline(*targets, slice(0, 3)), spline(4.0, 3.0, 10)
    focal, centre = spline(np.log(one.focal), np.log(other.focal), slice(6, 8)), spline(one.centre, other.centre, slice(8, 10))
    for frame in np.linspace(2, 12, 9):
        found = shot.camera_at(frame)
        assert np.allclose(found.position, target(frame) + distance(frame) * found.camera_to_world[:3, 2], rtol=0, atol=1e-8)
        assert np.allclose(found.focal, np.exp(focal(frame))) and np.allclose(found.centre, centre(frame))
    for frame, step, velocity in ((2.0, 1e-6, curve[0, 3:6]), (12.0, -1e-6, curve[1, 3:6])):
        turns = Rotation.from_matrix([shot.camera_at(frame + part).camera_to_world[:3, :3] for part in (0.0, step)])
        assert np.allclose((turns[1] * turns[0].inv()).as_rotvec() / step, velocity, rtol=0, atol=1e-5)


def test_a_curve_turns_the_shorter_way() -> None:
    """Between 170 and 190 degrees the quaternions of the two rotations, each with w above 0, are nearly opposite."""
    ends = []
    for angle in (170, 190):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        ends.append(camera(pose))
    assert quaternion(ends[0].camera_to_world[:3, :3]) @ quaternion(ends[1].camera_to_world[:3, :3]) < -0.9
    found = Shot((0.0, 5.0), tuple(ends), (), (np.zeros((2, 11)),)).camera_at(2.5)
    assert np.allclose(found.camera_to_world[:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-9)


def test_a_curve_is_read_written_and_moved(curve: np.ndarray) -> None:
    """Only a file with curves has version 2, and a similarity moves what is seen between keys, too."""
    cameras = over_the_pole(np.arange(3.0))
    path = CameraPath((Shot((1.0, 9.0, 20.0), tuple(cameras), (4.0, 4.5, 5.0), (curve, None)),), 1, 20, 24.0)
    value = json.loads(path_bytes(path))
    assert value["version"] == 2 and path_of(np.arange(3.0), cameras).to_json()["version"] == 1
    assert ["curve" in key for key in value["shots"][0]["keys"]] == [True, False, False]
    similarity = np.eye(4)
    similarity[:3, :3] = 2.5 * Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()
    similarity[:3, 3] = [3, -7, 1]
    for other, move in ((CameraPath.from_json(value), np.eye(4)), (path.moved(similarity), similarity)):
        for frame in np.linspace(0, 21, 22):
            found, truth = other.camera_at(frame), path.camera_at(frame).moved(move)
            assert np.allclose(found.camera_to_world, truth.camera_to_world, rtol=0, atol=1e-6)
            assert np.allclose(found.focal, truth.focal) and np.allclose(found.centre, truth.centre)


def test_a_curve_of_any_numbers_gives_a_camera() -> None:
    """Damaged velocities: quaternions that vanish on the way, lenses beyond all bounds."""
    one = camera(np.eye(4))
    half = np.eye(4)
    half[:3, :3] = np.diag([1.0, -1.0, -1.0])
    for worst in (1e4, -1e4):
        shot = Shot((0.0, 1e6), (one, camera(half)), (), (np.full((2, 11), worst),))
        assert all(np.isfinite(shot.camera_at(frame).camera_to_world).all() for frame in np.linspace(0, 1e6, 11))
    vanishing = np.zeros((2, 11))
    vanishing[:, 3] = -8.0  # radians a frame: half way through half a turn, all four numbers of the quaternion are 0
    shot = Shot((0.0, 1.0), (one, camera(half)), (), (vanishing,))
    assert all(np.isfinite(shot.camera_at(frame).camera_to_world).all() for frame in np.linspace(0, 1, 101))


def eased(u: np.ndarray) -> np.ndarray:
    return u * u * (3 - 2 * u)


@pytest.mark.parametrize("turn", [0.0, 1.2], ids=["a dolly", "an orbit"])
def test_an_eased_move_has_few_keys(turn: float) -> None:
    """It begins and ends at rest, as Blender's keys do by default: a handful of curves, where lines took three frames in four."""
    frames, cameras = np.arange(1.0, 101.0), []
    for u in eased((frames - 1) / 99):
        cameras.append(camera(looking((5 * math.sin(turn * u), -5 * math.cos(turn * u), 1 + u), (0.3 * u, 0, 0))))
    shot = thinned(Shot(tuple(frames), tuple(cameras)), np.array([[3.5, 7.0]] * 100), np.zeros(3))
    assert len(shot.frames) <= 5
    points = np.random.default_rng(2).uniform(-0.8, 0.8, (100, 3))
    for frame, truth in zip(frames, cameras, strict=True):
        assert np.abs(truth.project(points)[0] - shot.camera_at(frame).project(points)[0]).max() < TOLERANCE


def test_a_step_compares_few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long the move is, and whether its lines and curves fit: so that a window answers meanwhile."""
    frames = np.arange(120.0)
    shot = Shot(tuple(frames), tuple(camera(looking((math.sin(u / 10), -5, 1), (0, 0, 0))) for u in frames))
    compared = [0]

    def counting(a: np.ndarray, *more: object) -> np.ndarray:
        compared[-1] += len(a)
        return pixel_errors(a, *more)

    monkeypatch.setattr(thin_path, "pixel_errors", counting)
    monkeypatch.setattr(thin_path, "CHUNK", 20)
    steps = thin_path.thin_steps(shot, np.array([[3.5, 7.0]] * 120), np.zeros(3))
    while True:
        try:
            next(steps)
            compared.append(0)
        except StopIteration as end:
            found = end.value
            break
    assert max(compared) <= 20 and sum(compared) > 500
    assert 3 < len(found.frames) < 40


def test_noise_keeps_its_lines() -> None:
    """Where a curve reaches no farther than three lines, it would take more room."""
    frames, random = np.arange(1.0, 61.0), np.random.default_rng(4)
    poses = [looking((0, -5, 1), random.uniform(-0.1, 0.1, 3)) for _ in frames]
    shot = thinned(Shot(tuple(frames), tuple(map(camera, poses))), np.array([[3.5, 7.0]] * 60), np.zeros(3))
    assert all(curve is None for curve in shot.curves) and len(shot.frames) > 50


@pytest.mark.hard_case(77)
def test_a_rotation_has_one_quaternion() -> None:
    for turn in Rotation.random(200, random_state=5):
        assert quaternion(turn.as_matrix())[3] >= 0
    for axis in np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0], [0, -0.6, 0.8], [0.36, 0.48, 0.8]]):
        half = quaternion(2 * np.outer(axis, axis) - np.eye(3))  # of half turns w is 0
        assert abs(half[:3] @ axis) == pytest.approx(1, abs=1e-12) and abs(half[3]) < 1e-9


@pytest.mark.hard_case(77)
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-10, 3e-8, 1e-6, 1e-3])
def test_small_turns_are_even(angle: float) -> None:
    """As far as single digits of double precision allow: a slow pan does not jerk."""
    b = np.array([math.sin(angle / 2), 0, 0, math.cos(angle / 2)])
    parts = np.linspace(0, 1, 11)
    found = slerp(np.array([0.0, 0, 0, 1]), b, parts)
    assert found[:, 0] == pytest.approx(np.sin(parts * angle / 2), rel=1e-6, abs=1e-22) and np.abs(found[:, 3] - 1).max() < 1e-6


@pytest.mark.hard_case(77)
def test_keys_on_both_sides_of_a_pole() -> None:
    """A camera that passes straight above the scene neither rolls nor jumps, wherever its quaternion's sign or branch changes."""
    keys = np.arange(0.0, 361.0, 30.0)  # degrees; at 0 and 180 it looks along the vertical axis, where azimuth and Euler angles jump
    cameras = []
    for angle in keys:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("x", angle, degrees=True).as_matrix()
        pose[:3, 3] = 4 * pose[:3, 2]
        cameras.append(camera(pose))
    shot = Shot(tuple(keys), tuple(cameras), (4.0,) * len(keys))
    for angle in np.arange(0.0, 360.0, 11.3):
        truth = Rotation.from_euler("x", angle, degrees=True).as_matrix()
        found = shot.camera_at(angle)
        assert np.allclose(found.camera_to_world[:3, :3], truth, atol=1e-12) and np.allclose(found.position, 4 * truth[:, 2], atol=1e-11)


@pytest.mark.hard_case(77)
def test_clip_planes_between_keys() -> None:
    pose = looking((0, -4, 1), (0, 0, 0))
    shot = Shot((0.0, 2.0, 4.0), (camera(pose, far=math.inf), camera(pose, far=math.inf, near=0.3), camera(pose, far=50.0, near=0.3)))
    assert (shot.camera_at(1.0).near, shot.camera_at(1.0).far) == (pytest.approx(0.2), math.inf)
    assert shot.camera_at(3.0).far == pytest.approx(100) and shot.camera_at(4.0).far == 50


def test_the_first_and_the_last_key_are_their_cameras() -> None:
    frames = np.array([1.0, 4.0, 11.0])
    cameras = over_the_pole(frames, FAR)
    shot = Shot(tuple(frames), tuple(cameras))
    assert shot.camera_at(0.0) is cameras[0] and shot.camera_at(11.0) is cameras[2]


def test_a_moved_path_is_the_moved_cameras() -> None:
    """Turned, scaled and shifted: between keys too."""
    similarity = np.eye(4)
    similarity[:3, :3] = 2.5 * Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()
    similarity[:3, 3] = 5, -3, 2
    cameras = [camera(looking((4 * math.cos(a), 4 * math.sin(a), 1.0), (0, 0, 0))) for a in (0.0, 2.0)]
    path = CameraPath((Shot((0.0, 10.0), tuple(cameras), (4.0, 4.0)),), 0, 10, 24.0)
    for frame in (0.0, 2.5, 7.0, 10.0):
        expected = path.camera_at(frame).moved(similarity)
        assert np.allclose(path.moved(similarity).camera_at(frame).camera_to_world, expected.camera_to_world, atol=1e-9)


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_the_bound_is_what_projected_points_move(projection: str) -> None:
    """By cameras that differ in one thing each, against their own projections of the corners, edges and middle."""
    start = camera(looking((0.3, -4.0, 1.2), (0, 0, 0)), projection=projection, focal=(90.0, 110.0), centre=(150.0, 90.0))
    turned, dolly, shift = (start.camera_to_world.copy() for _ in range(3))
    turned[:3, :3] = turned[:3, :3] @ Rotation.from_euler("xyz", [0.05, 0.02, 0.1]).as_matrix()
    dolly[:3, 3] -= 0.7 * dolly[:3, 2]
    shift[:3, 3] += 0.2 * shift[:3, 0]
    others = [replace(start, focal=(120.0, 100.0)), replace(start, centre=(160.0, 85.0))]
    others += [replace(start, camera_to_world=pose) for pose in (turned, dolly, shift)]
    flat = np.stack(np.meshgrid([0, 160, 320], [0, 100, 200]), axis=-1).reshape(-1, 2).astype(float)
    near, far = 2.0, 8.0
    points = []
    for depth in (near, 4.0, far):
        across = (flat - start.centre) / start.focal * [1, -1] * (depth if projection == "perspective" else 1)
        local = np.concatenate([across, np.full((9, 1), -depth)], axis=-1)
        points.append(local @ start.camera_to_world[:3, :3].T + start.position)
    expected = [max(np.linalg.norm(o.project(p)[0] - flat, axis=-1).max() for p in points) for o in others]
    states = np.array([state_of(start, 0.0)] * len(others)), np.array([state_of(o, 0.0) for o in others])
    assert pixel_errors(*states, start, np.array([[near, far]] * len(others))) == pytest.approx(expected, rel=1e-9)
    back = replace(start, camera_to_world=start.camera_to_world @ np.diag([-1.0, 1, -1, 1]))
    clipped = replace(start, near=start.near + 0.5)
    found = [pixel_errors(state_of(start, 0)[None], state_of(o, 0)[None], start, np.array([[near, far]]))[0] for o in (back, clipped)]
    assert np.isinf(found[0]) == (projection == "perspective")
    assert found[1] == pytest.approx(110.0 * 0.5 / near)


@pytest.mark.hard_case(77)
def test_the_point_that_cameras_look_at() -> None:
    """Also a million units away; where all look one way there is none, and it stays near the cameras."""
    draw, point = np.random.default_rng(1), np.array([0.3, -0.2, 0.5])
    places = draw.normal(size=(40, 3)) * 3
    axes = places - point
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    for at in (np.zeros(3), FAR):
        assert np.allclose(looked_at(places + at, axes) - at, point, atol=1e-8)
    same = np.tile([0.36, 0.48, 0.8], (40, 1)) + 1e-12 * draw.normal(size=(40, 3))
    assert np.abs(looked_at(places, same / np.linalg.norm(same, axis=-1, keepdims=True))).max() < 20


def test_a_cut_shows_the_other_camera_at_once() -> None:
    one, other = (camera(looking((x, -4.0, 1.0), (0, 0, 0)), name=name) for x, name in ((0.0, "A"), (3.0, "B")))
    path = CameraPath((Shot((1.0, 10.0), (one, replace(one, focal=(150.0, 150.0)))), Shot((10.0,), (other,))), 1, 20, 25.0)
    assert [path.camera_at(frame).name for frame in (1, 9.999, 10, 20)] == ["A", "A", "B", "B"]
    assert path.camera_at(9.999).focal[0] == pytest.approx(150, rel=1e-3)


@pytest.mark.parametrize("at", [0.0, FAR], ids=["at the origin", "far from it"])
def test_a_file_holds_the_path(at: np.ndarray | float) -> None:
    frames = np.arange(1.0, 8.0)
    path = path_of(frames, over_the_pole(frames, at))
    data = path_bytes(path)
    back = CameraPath.from_json(json.loads(data))
    for frame in np.linspace(0, 8, 33):
        a, b = path.camera_at(frame), back.camera_at(frame)
        assert np.allclose(a.camera_to_world, b.camera_to_world, rtol=0, atol=1e-5 if np.any(at) else 1e-10)
        assert np.allclose(a.focal, b.focal) and np.allclose(a.centre, b.centre) and (a.near, a.far) == (b.near, b.far)
    still = Shot((1.0, 2.0, 3.0), (camera(np.eye(4)),) * 3)
    assert len(path_bytes(CameraPath((still,), 1, 3, 24.0))) < 350, "what stays is written once"


def test_fewer_keys_show_the_same_within_the_bound() -> None:
    """Points of the box are projected by the cameras themselves, not by the bound's own formula."""
    frames = np.arange(1.0, 121.0)
    cameras = over_the_pole(frames)
    points = np.random.default_rng(2).uniform(-0.8, 0.8, (200, 3))
    reach = [c.project(points)[1] for c in cameras]
    depths = np.array([[r.min(), r.max()] for r in reach])
    shot = thinned(Shot(tuple(frames), tuple(cameras)), depths, np.zeros(3))
    assert 2 < len(shot.frames) < 9 and shot.frames[0] == 1 and shot.frames[-1] == 120
    worst = 0.0
    for frame, truth in zip(frames, cameras, strict=True):
        there, here = truth.project(points)[0], shot.camera_at(frame).project(points)[0]
        inside = ((there >= 0) & (there <= [truth.width, truth.height])).all(axis=1)
        worst = max(worst, float(np.abs(there - here)[inside].max(initial=0)))
    assert 0.02 < worst < TOLERANCE
    between = np.arange(1.25, 120, 0.5)
    for frame, truth in zip(between, over_the_pole(np.append(between, 120.0)), strict=False):
        assert np.abs(truth.project(points)[0] - shot.camera_at(frame).project(points)[0]).max() < TOLERANCE, "nor does it shake between"
    elsewhere = thinned(Shot(tuple(frames), tuple(cameras)), depths, np.array([0.3, 0.2, 0.6]))
    assert len(elsewhere.frames) <= len(shot.frames) + 1, "the point that the camera looks at is found"
    assert len(thinned(Shot((1.0, 2.0, 3.0), (cameras[0],) * 3), np.ones((3, 2)), np.zeros(3)).frames) == 1, "what stands still has one key"


def test_a_jolt_of_one_frame_is_kept() -> None:
    frames = np.arange(60.0)
    cameras = [camera(looking((0, -4, 1), (0, 0, 0)))] * 60
    cameras[20] = replace(cameras[0], centre=(161.0, 100.0))
    shot = thinned(Shot(tuple(frames), tuple(cameras)), np.array([[2.0, 6.0]] * 60), np.zeros(3))
    assert shot.camera_at(20.0).centre[0] == pytest.approx(161) and abs(shot.camera_at(30.0).centre[0] - 160) < TOLERANCE


def test_an_orthographic_cameras_scale_and_turn_are_kept() -> None:
    frames, cameras = np.arange(1.0, 41.0), []
    for u in np.linspace(0, 1, 40):
        pose = looking((4 * math.sin(2 * u), -4 * math.cos(2 * u), 1.0), (0, 0, 0))
        cameras.append(camera(pose, projection="orthographic", focal=(60 + 40 * u, 60 + 40 * u)))
    points = np.random.default_rng(2).uniform(-0.8, 0.8, (100, 3))
    shot = thinned(Shot(tuple(frames), tuple(cameras)), np.array([[2.0, 6.0]] * 40), np.zeros(3))
    assert len(shot.frames) < 6
    for frame, truth in zip(frames, cameras, strict=True):
        assert np.abs(truth.project(points)[0] - shot.camera_at(frame).project(points)[0]).max() < TOLERANCE


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 3}, "version 3"),
        ({"fps": 0}, "fps is 0"),
        ({"fps": 5000}, "5000.0 frames a second"),
        ({"start": 9, "end": 3}, "the end must not be before"),
        ({"width": 0}, "width is 0"),
        ({"shots": []}, "0 keys"),
        ({"shots": 7}, "incomplete or damaged"),
        ({"shots": [{"name": "A", "projection": "fisheye", "keys": [{"frame": 1}]}]}, "position"),
        ({"shots": [{"name": "A", "projection": "perspective", "keys": []}]}, "needs a key"),
    ],
)
def test_what_is_no_path_is_refused(change: dict[str, object], words: str) -> None:
    frames = np.arange(1.0, 4.0)
    value = path_of(frames, over_the_pole(frames)).to_json() | change
    with pytest.raises(SnergError, match=words):
        CameraPath.from_json(value)


def test_a_curve_of_the_last_key_leads_nowhere() -> None:
    frames = np.arange(1.0, 4.0)
    damaged = path_of(frames, over_the_pole(frames)).to_json()
    damaged["shots"][0]["keys"][2]["curve"] = [[0.0] * 11] * 2
    with pytest.raises(SnergError, match="the last key of a shot has a curve"):
        CameraPath.from_json(damaged)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("frame", 1, "not in the order"),
        ("frame", "2", "frame is '2'"),
        ("rotation", [0, 0, 0, 0], "no quaternion"),
        ("rotation", [0, 0, 1], "rotation is"),
        ("position", [0, float("nan"), 0], "position holds"),
        ("focal", [-1, 1], "focal length"),
        ("far", 0, "far is 0"),
        ("near", 500.0, "far plane"),
        ("curve", [[0.0] * 11], "curve is"),
        ("curve", [[0.0] * 10 + [float("inf")]] * 2, "curve holds"),
    ],
)
def test_damaged_keys_are_refused(key: str, value: object, words: str) -> None:
    frames = np.arange(1.0, 4.0)
    damaged = path_of(frames, over_the_pole(frames)).to_json()
    damaged["shots"][0]["keys"][1][key] = value
    with pytest.raises(SnergError, match=words):
        CameraPath.from_json(damaged)
