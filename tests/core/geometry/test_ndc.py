"""Normalised device coordinates."""

import json

import numpy as np
import pytest

from scenes import looking
from snerg.core.errors import SnergError
from snerg.core.geometry.ndc import Ndc, space_rays, world_distance

FRAME = Ndc(looking((3.0, -2.0, 1.0), (4.0, 5.0, 0.0), roll=0.2), (1.2, 1.7), 0.8)


def local_rays(origins, directions):
    """Rays given in the frame's axes, as world rays with unit directions."""
    origins, directions = np.atleast_2d(origins).astype(float), np.atleast_2d(directions).astype(float)
    axes, position = FRAME.camera_to_world[:3, :3], FRAME.camera_to_world[:3, 3]
    return origins @ axes.T + position, directions / np.linalg.norm(directions, axis=-1, keepdims=True) @ axes.T


def forward_rays(count=400):
    draw = np.random.default_rng(3)
    origins = draw.uniform([-1, -1, -3], [1, 1, 1], (count, 3))  # before, on both sides of the near plane
    directions = np.concatenate([draw.normal(0, 0.7, (count, 2)), -np.ones((count, 1))], axis=-1)
    return local_rays(origins, directions)


@pytest.mark.hard_case(9)
@pytest.mark.parametrize("near", [0.0, 2.5])
def test_points_on_the_mapped_ray_lie_on_the_ray(near):
    origins, directions = forward_rays()
    o, d, begin, end = space_rays(FRAME, origins, directions, near)
    assert np.allclose(np.linalg.norm(d, axis=-1), 1, atol=1e-14) and (begin == 0).all()
    last = -np.inf
    for fraction in (0.0, 0.1, 0.5, 0.9, 0.99):
        world = FRAME.to_world(o + (fraction * end)[:, None] * d)
        t = world_distance(FRAME, origins, directions, fraction * end, near)
        assert np.abs(world - origins - t[:, None] * directions).max() < 1e-9 * np.abs(t).max()
        assert (t >= near - 1e-9).all() and (t > last).all()
        last = t


def test_rays_begin_at_the_near_plane_and_end_at_infinity():
    origins, directions = local_rays([[0, 0, 0.5], [0.3, 0.1, -2]], [[0.1, 0.2, -1], [0, 0.3, -1]])
    o, d, _, far = space_rays(FRAME, origins, directions)
    end = o + far[:, None] * d
    assert o[0, 2] == pytest.approx(-1) and np.allclose(o[1], FRAME.from_world(origins)[1])
    assert np.allclose(end[:, 2], 1) and np.allclose(end[0, :2], [1.2 * 0.1, 1.7 * 0.2])


def test_the_pictures_edges_and_the_two_planes():
    points, _ = local_rays([[1 / 1.2, 1 / 1.7, -1], [-2 / 1.2, 0, -2], [0, 0, -0.8], [0, 0, -1e12]], [[0, 0, -1]] * 4)
    assert np.allclose(FRAME.from_world(points)[:, 0], [1, -1, 0, 0])
    assert np.allclose(FRAME.from_world(points)[:, 1], [1, 0, 0, 0])
    assert np.allclose(FRAME.from_world(points)[2:, 2], [-1, 1])


def test_straight_lines_stay_straight_and_there_is_a_way_back():
    origins, directions = forward_rays(50)
    t = np.random.default_rng(0).uniform(4, 40, (50, 3))
    world = origins[:, None] + t[..., None] * directions[:, None]
    p = FRAME.from_world(world.reshape(-1, 3)).reshape(world.shape)
    assert np.abs(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])).max() < 1e-12
    assert np.abs(FRAME.to_world(p.reshape(-1, 3)) - world.reshape(-1, 3)).max() < 1e-9


@pytest.mark.hard_case(9)
def test_rays_that_see_nothing_of_it_are_misses_and_all_is_finite():
    directions = [[1, 0, 0], [0, -1, -0.0], [1, 1, -1e-9], [0, 0, 1], [1, 0, 0.3], [1e-200, 1, 1e-300]]
    for depth in (2.0, 0.0, -0.8, -5.0):
        origins, toward = local_rays([[0.1, 0.2, depth]] * len(directions), directions)
        with np.errstate(all="raise", under="ignore"):
            o, d, near, far = space_rays(FRAME, origins, toward, 0.0)
            t = world_distance(FRAME, origins, toward, far)
        assert np.isfinite(np.concatenate([o, d], axis=-1)).all() and (far <= near).all() and np.isfinite(t).all()
        assert np.allclose(np.linalg.norm(d, axis=-1), 1)
        assert (o[:, 2] > 1.5).all() and (d[:, 2] > 0).all(), "they meet no box, even where nobody looks at far"


@pytest.mark.hard_case(9)
def test_points_without_ndc_are_finite_and_outside():
    points, _ = local_rays([[0, 0, 0], [1, 1, 3], [0, 1, -1e-300]], [[0, 0, -1]] * 3)
    with np.errstate(all="raise", under="ignore"):
        p = FRAME.from_world(points)
        back = FRAME.to_world(np.array([[0.5, -0.5, 1.0], [0, 0, 7.0]]))
    assert np.isfinite(p).all() and (p[:, 2] < -1e6).all()
    assert np.isfinite(back).all() and (np.linalg.norm(back, axis=-1) > 1e8).all()


def test_without_ndc_rays_stay():
    origins, directions = forward_rays(7)
    o, d, near, far = space_rays(None, origins, directions, 0.3)
    assert o is origins and d is directions and (near == 0.3).all() and np.isinf(far).all()
    assert np.array_equal(world_distance(None, origins, directions, far), far)


def test_through_json_and_back():
    again = Ndc.from_json(json.loads(json.dumps(FRAME.to_json())))
    assert np.allclose(again.camera_to_world, FRAME.camera_to_world, atol=1e-15) and (again.focal, again.near) == (FRAME.focal, FRAME.near)


@pytest.mark.parametrize("focal, near", [((0.0, 1.0), 1.0), ((1.0, 1.0), 0.0), ((1.0, float("nan")), 1.0), ((1.0, 1.0), float("inf"))])
def test_frames_that_are_none(focal, near):
    with pytest.raises(SnergError, match="forward-facing frame"):
        Ndc(np.eye(4), focal, near)
