"""Cameras spread round a box."""

from __future__ import annotations

import math

import numpy as np
import pytest

from snerg.core.data.rig import RigSettings, directions, look_at, rig_cameras
from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box

BOX = Box.axis_aligned([1, 2, 3], [2, 4, 3.5])


@pytest.mark.parametrize("hemisphere", [True, False])
def test_directions_are_spread_evenly(hemisphere):
    found = directions(100, hemisphere)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1)
    cosines = found @ found.T - 2 * np.eye(100)
    nearest = np.arccos(cosines.max(axis=1))
    area = 2 * math.pi if hemisphere else 4 * math.pi
    even = math.sqrt(area / 100 * 2 / math.sqrt(3))  # the distance in a hexagonal lattice of that density
    assert nearest.min() > 0.6 * even
    assert (found[:, 2] > 0).all() == hemisphere


def test_every_camera_sees_the_whole_box_upright():
    cameras = rig_cameras(BOX, RigSettings(count=40, hemisphere=False), 160, 90)
    assert len(cameras) == 40
    for camera in cameras:
        pixels, depth = camera.project(BOX.corners())
        assert (depth > 0).all()
        assert (pixels > 0).all() and (pixels < [160, 90]).all()
        centre, _ = camera.project(BOX.box_to_world[None, :3, 3])
        np.testing.assert_allclose(centre, [[80, 45]], atol=1e-9)
        assert camera.camera_to_world[2, 1] >= 0


def test_straight_down_and_up_are_poses_too():
    for z in (-5.0, 5.0):
        pose = look_at(np.array([0, 0, z]), np.zeros(3))
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


@pytest.mark.hard_case(4)
@pytest.mark.parametrize(
    "settings",
    [{"count": 0}, {"angle": math.pi}, {"angle": 0.0}, {"distance": 0.1}, {"distance": -3}, {"distance": math.nan}],
)
def test_an_impossible_rig_is_refused(settings):
    with pytest.raises(SnergError):
        rig_cameras(BOX, RigSettings(**settings), 100, 100)
