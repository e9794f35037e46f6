"""Cameras, poses and rays."""

import math

import numpy as np
import pytest

from scenes import looking, make_cameras
from snerg.core.data.dataset import focus_box
from snerg.core.errors import SnergError
from snerg.core.geometry.camera import Camera, focal_from_angle, rigid


@pytest.mark.hard_case(1, 2, 3)
@pytest.mark.parametrize("index", range(6))
def test_rays_pass_through_what_projects_to_their_pixels(index):
    camera = make_cameras(width=31, height=23)[index]
    origins, directions = camera.rays()
    points = origins + directions * np.linspace(1, 5, len(origins))[:, None]
    pixels, depth = camera.project(points)
    rows, columns = np.divmod(np.arange(len(origins)), camera.width)
    assert np.abs(pixels - np.stack([columns, rows], axis=-1) - 0.5).max() < 1e-9
    assert (depth > 0).all() and np.allclose(np.linalg.norm(directions, axis=-1), 1)
    assert np.allclose(camera.toward(points), directions)


def test_the_top_left_pixel_looks_up_and_left():
    camera = Camera(8, 8, (8, 8), (4, 4), np.eye(4))
    first = camera.rays(np.array([[0, 0]]))[1][0]
    assert first[0] < 0 < first[1] and first[2] < 0


def test_resizing_keeps_the_view():
    camera = make_cameras(width=40, height=30)[1]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    assert np.allclose(camera.resized(80, 90).project(points)[0], camera.project(points)[0] * [2, 3])


@pytest.mark.hard_case(4)
@pytest.mark.parametrize("angle", [0.0, math.pi, -1.0, math.nan, math.inf])
def test_fields_of_view_without_a_picture(angle):
    with pytest.raises(SnergError, match="field of view"):
        focal_from_angle(angle, 800, "The camera")


@pytest.mark.hard_case(5)
def test_scale_changes_no_ray():
    pose = looking((1, 2, 3), (0, 0, 0))
    scaled = pose @ np.diag([2, 3, 0.5, 1])
    assert np.allclose(rigid(scaled, "x"), pose)


@pytest.mark.hard_case(5)
@pytest.mark.parametrize(
    "bad", [np.diag([-1.0, 1, 1, 1]), np.diag([1.0, 0, 1, 1]), np.full((4, 4), np.nan), np.ones((4, 4)), np.ones((2, 2))]
)
def test_poses_that_are_none(bad):
    with pytest.raises(SnergError, match="pose"):
        rigid(bad, "Camera 'A'")


def test_panoramic_is_refused_by_name():
    with pytest.raises(SnergError, match="panoramic"):
        Camera(8, 8, (8, 8), (4, 4), np.eye(4), "panoramic")


def test_the_suggested_box_holds_what_cameras_look_at():
    cameras = tuple(
        Camera(64, 64, (80, 80), (32, 32), looking((4 * math.cos(a) + 10, 4 * math.sin(a), 1.5), (10, 0, 0))) for a in np.linspace(0, 6, 9)
    )
    box = focus_box(cameras)
    assert np.allclose(box.box_to_world[:3, 3], [10, 0, 0], atol=1e-6)
    assert box.size[0] == pytest.approx(2 * math.hypot(4, 1.5) * 0.4, rel=1e-6)


def test_a_suggested_box_for_cameras_that_look_one_way():
    cameras = tuple(Camera(64, 64, (80, 80), (32, 32), looking((x, 0, 0), (x, 5, 0))) for x in (-1, 0, 1))
    box = focus_box(cameras)
    assert np.isfinite(box.size).all() and box.box_to_world[1, 3] > 0
