"""The training box of captures of many kinds: it holds what the pictures show, and not what lies astray."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import ring, write_ngp

from scenes import looking
from snerg.core.data.coverage import coverage, crossing, facing, median_depth, seen
from snerg.core.data.dataset import Dataset, DatasetOptions, Source, StatedBox, View
from snerg.core.data.load import read_dataset
from snerg.core.data.orient import orient
from snerg.core.data.readers.transforms import read_stated_box
from snerg.core.data.training_box import TrainingBox, together, training_box
from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.io.images import write_png

ALL = DatasetOptions(holdout=0)
DRAW = np.random.default_rng


def shot(eye, target, focal: float = 40.0) -> Camera:
    return Camera(48, 36, (focal, focal), (24, 18), looking(tuple(eye), tuple(target)))


def oriented(cameras, points=None, bounds=None, stated=None, photographs: bool = True) -> tuple[TrainingBox, Source, np.ndarray]:
    """(the training box, the oriented source, [4, 4] from the cameras' world to its world)."""
    views = tuple(View(camera, Path(f"{i}.png")) for i, camera in enumerate(cameras))
    source = Source(Path("a"), "colmap", views, photographs=photographs, points=points, bounds=bounds, stated=stated)
    source, similarity = orient(source) if photographs else (source, np.eye(4))
    return training_box(source), source, similarity


def held(box: Box, similarity: np.ndarray, points: np.ndarray) -> float:
    """The share of points of the cameras' world that lie in the box."""
    return float(box.contains(points @ similarity[:3, :3].T + similarity[:3, 3]).mean())


def ball(count: int, radius: float, seed: int = 0) -> np.ndarray:
    points = DRAW(seed).normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=-1, keepdims=True)


def room(count: int = 900) -> np.ndarray:
    """Points on the walls, the floor and the ceiling of a room of 6 x 8 x 3."""
    points = DRAW(2).uniform(-1, 1, (count, 3))
    axis = np.arange(count) % 3
    points[np.arange(count), axis] = np.sign(points[np.arange(count), axis])
    return points * [3, 4, 1.5]


def outward(count: int = 24, radius: float = 0.5) -> list[Camera]:
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ways = [np.array([np.cos(t), np.sin(t), 0.2 * np.sin(5 * t)]) for t in turns]
    return [shot(radius * way, 5 * way) for way in ways]


def test_the_measures_of_a_box():
    camera = Camera(40, 40, (20, 20), (20, 20), looking((0, -4, 0), (0, 0, 0)))  # sees 4 to each side, 4 away
    wide, half = Box.axis_aligned([-9, -1, -9], [9, 1, 9]), Box.axis_aligned([0, 0, -9], [9, 0.01, 9])
    behind = Box.axis_aligned([-1, -9, -1], [1, -5, 1])
    assert crossing(wide, [camera]) == 1 and crossing(half, [camera]) == pytest.approx(0.5, abs=0.03) and crossing(behind, [camera]) == 0
    assert crossing(Box.axis_aligned([-1, -5, -1], [1, -3, 1]), [camera]) == 1  # the camera stands inside
    assert crossing(wide, [camera, shot((0, 0, 20), (0, 0, 40))]) == 0.5
    assert seen(behind, [camera]) == 0 and seen(Box.axis_aligned([-8, -0.1, -0.1], [8, 0.1, 0.1]), [camera]) == 0.5
    points = np.array([[0, 0, 0], [0, 0.5, 0], [0, 5.0, 0], [0, -5.0, 0]])
    assert coverage(wide, [camera], points).points == 0.5 and coverage(wide, [camera], None).points is None
    assert median_depth([camera], points) == 4.5 and median_depth([camera], points[3:]) is None
    assert facing([camera], np.zeros(3)) == pytest.approx(1) and facing([camera], np.array([0, -9, 0])) == pytest.approx(-1)


def test_rays_cross_a_box_that_is_turned():
    """Of a turned box of three sides, in a wide picture, against points along each ray; and of rays within its faces."""
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = looking((0.4, -0.7, 0.5), (0, 0, 0))[:3, :3], (3.0, -1.0, 0.5)
    box = replace(Box.axis_aligned([-1, -0.4, -0.2], [1, 0.4, 0.2]), box_to_world=turn)
    camera = Camera(160, 48, (50, 50), (80, 24), looking((1.0, -5.0, 1.5), (3, -1, 0.5)))
    across, down = (((np.arange(16) + 0.5) * n / 16).astype(int) for n in (160, 48))
    origins, directions = camera.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    local = (origins[:, None] + directions[:, None] * np.linspace(0, 9, 900)[:, None] - turn[:3, 3]) @ turn[:3, :3]
    inside = (np.abs(local) <= [1, 0.4, 0.2]).all(axis=-1).any(axis=-1)
    assert crossing(box, [camera]) == pytest.approx(inside.mean(), abs=0.012) and 0.02 < inside.mean() < 0.4
    straight = Camera(32, 32, (8, 8), (16.5, 16.5), looking((0, -4, 0), (0, 0, 0)), "orthographic")
    eye = straight.rays(np.array([[15, 15]]))[0][0]
    for low, high in (([eye[0], -1, -9], [9, 1, 9]), ([-9, -1, eye[2]], [9, 1, 9])):
        assert crossing(Box.axis_aligned(low, high), [straight]) == pytest.approx(0.5, abs=0.07)


def test_a_stated_box_that_is_no_cube_is_held(tmp_path):
    for name, top in (
        ("aabb", {"aabb": [[-1, -2, -0.5], [1, 2, 0.5]]}),
        ("scene_box", {"scene_box": {"aabb": [[-1, -2, -0.5], [1, 2, 0.5]]}}),
    ):
        stated = read_stated_box(tmp_path / "transforms.json", {"aabb_scale": 4, **top})
        half = 8.0 if name == "aabb" else 2.0
        assert stated.box.size == pytest.approx([2 * half] * 3) and stated.box.contains(np.array([[0.99, 1.99, 0.49]])).all()


def test_points_that_fill_the_pictures_give_a_box_of_their_size():
    found, _, by = oriented([replace(c, focal=(60.0, 60.0)) for c in ring(12)], ball(500, 1.0))
    assert held(found.box, by, ball(500, 1.0, 1)) == 1 and found.box.size.max() < 3 and "500 points" in found.origin


@pytest.mark.parametrize("astray", [0, 2, 20])
def test_points_on_a_part_of_the_pictures_are_no_worse_than_none(astray):
    points = np.concatenate([ball(100, 0.4), DRAW(1).uniform(-6, 6, (astray, 3))])
    found, _, _ = oriented(ring(12), points)
    without, source, _ = oriented(ring(12))
    assert found.box.contains(without.box.corners() * (1 - 1e-9)).all() and found.box.size.max() < 16
    assert "part of what the pictures show" in found.origin and coverage(found.box, [v.camera for v in source.views], None).rays > 0.99


@pytest.mark.parametrize("focal", [26.0, 60.0])
def test_a_statue_with_few_points_is_not_sawn_off(focal):
    foot = DRAW(0).uniform(-1, 1, (5000, 3)) * [1, 1, 0.05] - [0, 0, 1]
    statue = DRAW(1).uniform(-1, 1, (40, 3)) * [0.2, 0.2, 1]
    found, _, by = oriented([replace(c, focal=(focal, focal)) for c in ring(12)], np.concatenate([foot, statue]))
    assert held(found.box, by, statue) == 1 and held(found.box, by, foot) == 1


@pytest.mark.parametrize("share", [0.01, 0.25])
@pytest.mark.parametrize("count", [300, 20000])
def test_outliers_do_not_widen_the_box(share, count):
    points = ball(count, 1.0)
    few = int(count * share)
    points[:few] = DRAW(1).normal(size=(few, 3)) * 50
    found, _, by = oriented([replace(c, focal=(60.0, 60.0)) for c in ring(12)], points)
    assert held(found.box, by, points[few:]) == 1 and found.box.size.max() < 4


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_a_room_seen_from_inside_keeps_its_walls(scale):
    cameras = [c.moved(np.diag([scale, scale, scale, 1])) for c in outward()]
    found, _, by = oriented(cameras, room() * scale)
    assert held(found.box, by, room() * scale) > 0.99 and found.box.size.max() < 24
    bounds = np.full((24, 2), [1.5, 5.0]) * scale
    found, _, by = oriented(cameras, None, bounds)
    assert held(found.box, by, room() * scale) > 0.9


def test_a_room_with_points_on_one_wall_is_held_whole():
    wall = room(2700)
    found, _, by = oriented(outward(), wall[wall[:, 1] == 4])
    assert held(found.box, by, room()) > 0.95 and "as far on all sides" in found.origin


def test_points_of_a_background_are_no_outliers():
    tight = [replace(c, focal=(60.0, 60.0)) for c in ring(12)]
    far = ball(400, 30.0, 1) * [1, 1, 0.3]
    found, _, _ = oriented(tight, np.concatenate([ball(500, 1.0), far]))
    assert found.box.size.min() > 11 and "500 of 900 points" in found.origin


def pictured(folder: Path, half: np.ndarray, contrast: float, count: int = 16) -> list[View]:
    """Views from the middle of a room of `half` [3] to each side, whose walls are painted in patches of many sizes."""
    views, waves = [], DRAW(0).normal(size=(24, 3)) * np.geomspace(1, 8, 24)[:, None]
    for index, camera in enumerate(outward(count, 0.3)):
        origins, directions = camera.rays()
        walls = np.where(directions > 0, half, -half)
        way = ((walls - origins) / np.where(directions == 0, 1e-9, directions)).min(axis=-1, keepdims=True)
        paint = np.sign(np.sin((origins + way * directions) @ waves.T)).reshape(-1, 3, 8).mean(axis=-1)
        pixels = (127 + contrast * 120 * paint).astype(np.uint8).reshape(camera.height, camera.width, 3)
        write_png(folder / f"{index}.png", pixels)
        views.append(View(camera, folder / f"{index}.png"))
    return views


@pytest.mark.parametrize("photographs", [True, False])
@pytest.mark.parametrize("half", [(1.5, 1.5, 1.2), (5.0, 4.0, 2.0)])
def test_a_room_without_points_is_measured_by_parallax(tmp_path, half, photographs):
    source = Source(tmp_path, "transforms", tuple(pictured(tmp_path, np.array(half), 1.0)), photographs=photographs)
    source, by = orient(source) if photographs else (source, np.eye(4))
    found = training_box(source)
    back = np.linalg.inv(by)
    corners = found.box.corners() @ back[:3, :3].T + back[:3, 3]
    across = np.abs(corners[:, :2]).max(axis=0)
    assert (across > 0.85 * np.array(half)[:2]).all() and (across < 2 * max(half)).all() and "patches" in found.origin


def test_a_room_without_points_and_texture_is_guessed_and_says_so(tmp_path):
    source = Source(tmp_path, "transforms", tuple(pictured(tmp_path, np.array([2.0, 2.0, 1.0]), 0.0)))
    found = training_box(source)
    assert found.box.contains(np.array([[2.0, 2.0, 1.0]])).all() and "Give points, or a box" in found.origin


def test_renders_that_look_inward_hold_their_surroundings_where_nothing_is_transparent():
    found, source, _ = oriented(ring(12), ball(100, 5.0), photographs=False)
    assert found.box is None and Dataset(Path("a"), "train", source.views).suggested_box().size.max() < 6
    assert found.opaque.size.min() == pytest.approx(12) and "neither alpha nor a plain backdrop" in found.origin
    stated = StatedBox(Box.axis_aligned([-2, -2, -1], [2, 2, 5]), "aabb_scale")
    bound, _, _ = oriented(ring(12), stated=stated, photographs=False)
    assert np.allclose(bound.opaque.corners(), stated.box.corners()) and bound.box.size.max() <= 4
    assert oriented(ring(12)[:1], photographs=False)[0].opaque is None


@pytest.mark.parametrize("height", [1.0, 30.0])
def test_a_field_from_a_drone_is_held_whole(height):
    places = np.stack(np.meshgrid(np.linspace(-5, 5, 7), np.linspace(-3, 3, 5)), -1).reshape(-1, 2)
    cameras = [shot((x * height, y * height, height), (x * height, y * height + 0.05 * height, 0)) for x, y in places]
    ground = DRAW(0).uniform(-1, 1, (4000, 3)) * [5.4, 3.4, 0.05] * height
    found, _, by = oriented(cameras, ground)
    assert held(found.box, by, ground) > 0.99 and found.box.size.min() < 0.5 * found.box.size.max()


@pytest.mark.parametrize("sideways", [True, False])
def test_a_street_is_held_whole(sideways):
    cameras = [shot((0, y, 1.6), (10 * sideways, y + 20 * (not sideways), 2)) for y in np.linspace(0, 60, 31)]
    walls = DRAW(0).uniform(-1, 1, (4000, 3)) * [0.3, 35, 3] + [0, 30, 3]
    walls[:, 0] += np.where(np.arange(4000) % 2, 8, -8) if not sideways else 8
    found, _, by = oriented(cameras, walls)
    assert held(found.box, by, walls) > 0.95


def test_an_object_on_a_turntable_with_points_of_its_background():
    points = np.concatenate([ball(600, 1.0), ball(200, 40.0, 1), ball(60, 9.0, 2)])
    found, _, by = oriented(ring(24), points)
    assert held(found.box, by, points[:600]) == 1 and found.box.size.max() <= 16


def test_a_close_up_with_far_points():
    cameras = [shot((x, -1.0, 0.1 * x), (0, 0, 0)) for x in np.linspace(-0.7, 0.7, 15)]
    face, far = ball(800, 0.25), DRAW(0).uniform(-1, 1, (400, 3)) * [8, 1, 5] + [0, 12, 0]
    found, _, by = oriented(cameras, np.concatenate([face, far]))
    assert held(found.box, by, face) == 1


@pytest.mark.parametrize("points", [None, np.zeros((0, 3)), np.zeros((5, 3)), ball(40, 900.0)])
def test_captures_whose_points_say_nothing(points):
    found, _, _ = oriented(ring(12), points)
    assert found.box.contains(np.zeros((1, 3))).all() and 11 < found.box.size.max() < 13


CUBES = {
    "offset": ({"aabb_scale": 1, "scale": 0.2, "offset": [-0.7, 1.1, 0.1]}, 2.5),
    "one offset": ({"aabb_scale": 2, "scale": 0.4, "offset": 0.5}, 2.5),
    "aabb": ({"aabb": [[4.4, -4.6, 0.4], [7.6, -1.4, 3.6]], "aabb_scale": 1}, 1.6),
    "corners the other way": ({"aabb": [[7.6, -3.5, 3.6], [4.4, -2.5, 0.4]]}, 1.6),
    "sdfstudio": ({"scene_box": {"aabb": [[4.0, -5.0, 0.0], [8.0, -1.0, 4.0]]}}, 2.0),
}


@pytest.mark.parametrize("name", CUBES)
def test_a_cube_that_the_file_states_is_where_the_file_says(tmp_path, name):
    top, half = CUBES[name]
    place = np.eye(4)
    place[:3, 3] = (0, 0, 0) if name == "one offset" else (6, -3, 2)
    folder = write_ngp(tmp_path / "a", [c.moved(place) for c in ring()], **{"aabb_scale": 1, **top})
    dataset = read_dataset(folder, options=ALL)
    back = np.linalg.inv(dataset.source_to_world)
    centre = back[:3, :3] @ dataset.box.box_to_world[:3, 3] + back[:3, 3]
    assert np.allclose(centre, place[:3, 3], atol=1e-6)
    assert dataset.box.size / 2 / dataset.scale == pytest.approx(half) and "The file states it" in dataset.box_origin


@pytest.mark.parametrize("key", [{"aabb_scale": 64, "offset": [-0.7, 1.1, 0.1], "scale": 0.2}, {"aabb": [[-90, -99, -94], [102, 93, 98]]}])
def test_a_cube_far_larger_than_the_cameras_is_an_upper_bound(tmp_path, key):
    place = np.eye(4)
    place[:3, 3] = (6, -3, 2)
    dataset = read_dataset(write_ngp(tmp_path / "a", [c.moved(place) for c in ring()], **key), options=ALL)
    assert dataset.box.size.max() < 13 and "upper bound" in dataset.box_origin


@pytest.mark.parametrize("photographs", [True, False])
def test_a_cube_that_no_camera_sees_is_replaced_and_said(photographs):
    stated = StatedBox(Box.axis_aligned([50, 50, 50], [51, 51, 51]), "aabb")
    found, source, _ = oriented(ring(12), stated=stated, photographs=photographs)
    dataset = Dataset(Path("a"), "train", source.views, found.box, found.origin)
    assert "Only 0 % of the rays cross the box that the file states (aabb)" in dataset.box_origin
    assert coverage(dataset.suggested_box(), dataset.cameras, None).rays > 0.99


@pytest.mark.parametrize(
    "value", [{"aabb": [[0, 0], [1, 1]]}, {"aabb": 3}, {"scene_box": 1}, {"scale": 0}, {"offset": ["a"]}, {"aabb_scale": -1}]
)
def test_a_damaged_cube_is_a_sentence(tmp_path, value):
    with pytest.raises(SnergError, match=r"transforms\.json has an "):
        read_dataset(write_ngp(tmp_path / "a", ring(), **value), options=ALL)


def test_an_artists_box_is_taken_as_it_is(tmp_path):
    folder = write_ngp(tmp_path / "a", ring())
    value = json.loads((folder / "transforms.json").read_text())
    box = Box.axis_aligned([30, 30, 30], [31, 31, 31])
    (folder / "transforms.json").write_text(json.dumps({**value, "snerg_box": box.to_json()}))
    dataset = read_dataset(folder, options=ALL)
    assert np.allclose(dataset.box.corners(), box.corners()) and "snerg_box" in dataset.box_origin


@pytest.mark.parametrize("count", [30, 3000])
def test_points_side_by_side_are_together(count):
    points = np.concatenate([ball(count, 1.0), [[7.0, 7, 7], [-7.5, 2, 3]]])
    keep = together(points, np.full(3, -8.0), np.full(3, 8.0))
    assert keep[:-2].mean() > 0.9 and not keep[-2:].any()
