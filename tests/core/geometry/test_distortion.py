"""Lenses: against the published formulas in float64, there and back, and where their polynomials fold over."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from scenes import looking
from snerg.core.errors import SnergError
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.distortion import Distortion, Lenses

PHONE = Distortion("opencv", (0.0578421, -0.0805099, -0.000980296, 0.00015575))
BARREL = Distortion("opencv", (-0.35, 0.14, 0.002, -0.001, -0.02))
PINCUSHION = Distortion("opencv", (0.4, 0.3, 0.01, 0.02))
RATIONAL = Distortion("opencv", (5.2, 2.1, 1e-4, -2e-4, 0.1, 5.5, 3.6, 0.4))
FOLDS = Distortion("opencv", (-0.3, 0.0))  # r (1 - 0.3 r^2) turns back at r = 1.054
FISHEYE = Distortion("fisheye", (0.02, -0.01, 0.003, -0.001))
EQUIDISTANT = Distortion("fisheye")
ALL = (PHONE, BARREL, PINCUSHION, RATIONAL, FOLDS, FISHEYE, EQUIDISTANT)


def published(lens: Distortion, x: float, y: float) -> tuple[float, float]:
    """As OpenCV's manual has it, one point in plain floats."""
    r = math.hypot(x, y)
    if lens.model == "fisheye":
        k1, k2, k3, k4 = lens.coefficients
        t = math.atan(r)
        bent = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)
        return (x * bent / r, y * bent / r) if r else (0.0, 0.0)
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.coefficients
    s = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return x * s + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2), y * s + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y


@pytest.mark.parametrize("lens", ALL)
def test_lenses_bend_as_published(lens):
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (200, 2))
    expected = np.array([published(lens, *p) for p in points])
    assert np.abs(lens.distort(points) - expected).max() < 1e-14


@pytest.mark.parametrize("lens", ALL)
def test_there_and_back(lens):
    points = np.random.default_rng(1).uniform(-0.72, 0.72, (5000, 2))
    assert np.abs(lens.undistort(lens.distort(points)) - points).max() < 1e-9
    assert lens.is_valid(lens.distort(points)).all()


def test_a_fisheye_nearly_to_the_side():
    angle, around = np.random.default_rng(2).uniform(0, [[math.radians(88)], [2 * math.pi]], (2, 3000))
    points = np.tan(angle)[:, None] * np.stack([np.cos(around), np.sin(around)], axis=-1)
    back = FISHEYE.undistort(FISHEYE.distort(points))
    assert np.abs(np.arctan(np.hypot(*back.T)) - angle).max() < 1e-8


@pytest.mark.parametrize("lens", ALL)
def test_every_pixel_has_a_finite_ray(lens):
    """Also far outside, where a polynomial has folded over and nothing maps to: Newton's method alone runs away there."""
    points = np.random.default_rng(3).uniform(-1, 1, (20000, 2)) * np.geomspace(1e-12, 1e6, 20000)[:, None]
    points[0] = 0
    for found in (lens.undistort(points), lens.distort(points)):
        assert np.isfinite(found).all()
    camera = Camera(40, 30, (6.0, 6.0), (20, 15), np.eye(4), distortion=lens)  # a field of view of 147 degrees
    origins, directions = camera.rays()
    assert np.isfinite(origins).all() and np.allclose(np.linalg.norm(directions, axis=-1), 1)


def test_what_lies_past_a_fold_is_not_seen():
    edge = 1 / math.sqrt(0.9)  # where 1 - 0.9 r^2 is 0
    farthest = edge * (1 - 0.3 * edge**2)
    assert FOLDS.is_valid(np.array([[farthest * 0.999, 0], [0, -farthest * 1.001]])).tolist() == [True, False]
    outside = FOLDS.distort(np.array([[edge * 1.3, 0]]))  # the polynomial would put this at 0.67, inside the picture
    assert outside[0, 0] > farthest
    camera = Camera(40, 30, (10.0, 10.0), (20, 15), np.eye(4), distortion=FOLDS)
    seen = camera.valid_pixels()
    assert seen is not None and seen[15, 20] and not seen[0, 0]
    assert Camera(40, 30, (60.0, 60.0), (20, 15), np.eye(4), distortion=FOLDS).valid_pixels() is None


def test_rays_of_a_lens_meet_what_projects_to_their_pixels():
    for lens in (PHONE, BARREL, RATIONAL, FISHEYE):
        camera = Camera(31, 23, (25.0, 27.0), (14, 12.5), looking((1, 2, 3), (0.2, 0, 0.1)), distortion=lens)
        origins, directions = camera.rays()
        pixels, depth = camera.project(origins + directions * np.linspace(1, 5, len(origins))[:, None])
        assert (depth > 0).all() and np.abs(pixels - camera.pixels() - 0.5).max() < 1e-7
        half = camera.resized(62, 46)
        points = origins + directions * 2
        assert np.allclose(half.project(points)[0], 2 * camera.project(points)[0])


def test_a_barrel_shows_more_than_its_focal_length_says():
    """The sign: with k1 < 0 the ray of a corner is further out than without a lens, and y down in the model is y up here."""
    plain = Camera(40, 40, (20.0, 20.0), (20, 20), np.eye(4))
    barrel = Camera(40, 40, (20.0, 20.0), (20, 20), np.eye(4), distortion=Distortion("opencv", (-0.2,)))
    tangential = Camera(40, 40, (20.0, 20.0), (20, 20), np.eye(4), distortion=Distortion("opencv", (0, 0, 0.05)))
    corner = np.array([[0, 0]])
    assert plain.rays(corner)[1][0, 2] < barrel.rays(corner)[1][0, 2]
    point = np.array([[0.0, 0.5, -1.0]])  # above the axis; p1 > 0 shifts downwards in the picture
    assert tangential.project(point)[0][0, 1] > plain.project(point)[0][0, 1]


def test_several_lenses_at_once():
    lenses = Lenses(ALL)
    which = np.arange(700) % len(ALL)
    points = np.random.default_rng(4).uniform(-0.7, 0.7, (700, 2))
    together = lenses.undistort(which, points)
    for i, lens in enumerate(ALL):
        assert np.abs(together[which == i] - lens.undistort(points[which == i])).max() < 1e-9


def test_cameras_as_json():
    for lens in (None, PHONE, FISHEYE):
        camera = Camera(31, 23, (25.0, 27.0), (14, 12.5), looking((1, 2, 3), (0, 0, 0)), "perspective", "A", 0.25, lens)
        same = Camera.from_json(json.loads(json.dumps(camera.to_json())))
        assert np.allclose(same.camera_to_world, camera.camera_to_world, rtol=0, atol=1e-15)
        assert {**same.to_json(), "camera_to_world": 0} == {**camera.to_json(), "camera_to_world": 0} and same.distortion == lens


@pytest.mark.parametrize("bad", [{}, [], None, 3, {"width": 3}, {"model": "opencv"}])
def test_json_that_is_no_camera(bad):
    for kind in (Camera, Distortion):
        with pytest.raises(SnergError):
            kind.from_json(bad)


@pytest.mark.hard_case(59)
def test_lenses_that_are_none():
    for model, coefficients in (("fov", ()), ("opencv", (math.nan,)), ("fisheye", (0,) * 5), ("opencv", (math.inf,))):
        with pytest.raises(SnergError, match="lens"):
            Distortion(model, coefficients)
    with pytest.raises(SnergError, match="lens"):
        Camera(4, 4, (1.0, 1.0), (2, 2), np.eye(4), "orthographic", distortion=PHONE)
