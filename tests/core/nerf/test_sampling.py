"""The visual hull, the occupancy grid and packed samples, against brute force."""

import numpy as np
import pytest

from scenes import looking, make_cameras
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.geometry.distortion import Distortion
from snerg.core.nerf.sampling import CELLS, Domain, Occupancy, carve, cell_centres, cell_index, dilated, hull, pack_samples

DOMAIN = Domain(np.zeros(3), 1.0, np.array([-1.0, -0.8, -0.9]), np.array([1.0, 0.8, 0.9]))


def balls(cameras, radius=0.4):
    """Silhouettes of a ball at the origin."""
    masks = []
    for camera in cameras:
        origins, directions = camera.rays()
        closest = np.linalg.norm(np.cross(origins, directions), axis=-1)
        ahead = (origins * directions).sum(axis=-1) < 0
        masks.append((ahead & (closest < radius)).reshape(camera.height, camera.width))
    return masks


def test_the_hull_holds_the_object_and_little_else():
    cameras = [c for c in make_cameras(width=120, height=120) if c.name not in ("Inside", "Near plane", "Far plane")]
    box = Box.axis_aligned([-1, -1, -1], [1, 1, 1])
    domain, alive = hull(box, cameras, balls(cameras))
    centres = domain.to_world(cell_centres(CELLS))
    distance = np.linalg.norm(centres, axis=-1)
    assert alive[distance < 0.39].all()
    assert (distance[alive] < 0.75).mean() > 0.95
    assert domain.world_box().size.max() < 1.6


@pytest.mark.parametrize("projection", ["equirectangular", "fisheye"])
def test_wide_cameras_carve_and_keep_the_object(projection):
    """Cameras that look past the ball, whose pictures show it at the seam, near a pole or at the edge of a fisheye too."""
    cameras = []
    for index, around in enumerate(np.linspace(0, 2 * np.pi, 12, endpoint=False)):
        eye = 1.8 * np.array([np.cos(around), np.sin(around), 0.6 * np.sin(3 * around)])
        pose = looking(tuple(eye), tuple(np.array([[0, 0, 0], [0, 0, 9], 2 * eye, [eye[1] * 9, -eye[0] * 9, 0]][index % 4])), 0.3 * index)
        if projection == "equirectangular":
            cameras.append(Camera(160, 80, panorama_focal(160, 80), (80, 40), pose, projection))
        else:
            cameras.append(Camera(120, 120, (34.0, 36.0), (60, 60), pose, projection, distortion=Distortion("fisheye", (0.02, -0.004))))
    points = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    alive, distance = carve(points, cameras, balls(cameras), 0.02), np.linalg.norm(points, axis=-1)
    assert alive[distance < 0.41].all() and alive[distance > 0.8].mean() < 0.1


def test_cameras_without_alpha_keep_what_they_see():
    cameras = make_cameras(width=60, height=60)[:2]
    points = np.array([[0.0, 0, 0], [0, 0, 50]])
    assert carve(points, cameras, [None, None], 0.01).tolist() == [True, False]


def test_silhouettes_that_do_not_agree_fall_back_to_the_box():
    cameras = make_cameras(width=30, height=30)[:2]
    _, alive = hull(Box.axis_aligned([-1, -1, -1], [1, 1, 1]), cameras, [np.zeros((30, 30), bool)] * 2)
    assert alive.all()


def test_dilation_of_a_mask():
    mask = np.zeros((9, 7), bool)
    mask[4, 0] = True
    grown = dilated(mask, 2)
    assert grown[2:7, :3].all() and grown.sum() == 15


@pytest.mark.parametrize("length", [2 / 256, 2 / 64, 2 / 32])
def test_packed_samples_are_all_that_lie_in_occupied_cells(length):
    draw = np.random.default_rng(0)
    occupied = np.zeros((CELLS,) * 3, bool)
    for low in draw.integers(30, 90, (12, 3)):
        occupied[tuple(slice(a, a + 14) for a in low)] = True
    occupied = occupied.reshape(-1)
    origins = draw.normal(size=(200, 3))
    origins *= 2.5 / np.linalg.norm(origins, axis=-1, keepdims=True)
    directions = draw.uniform(-0.6, 0.6, (200, 3)) - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    offset = draw.random(200)
    got = pack_samples(DOMAIN, occupied, origins, directions, length, offset)
    expected = []
    for ray in range(200):
        walls = np.stack([(DOMAIN.low - origins[ray]) / directions[ray], (DOMAIN.high - origins[ray]) / directions[ray]])
        enter, leave = max(walls.min(axis=0).max(), 0), walls.max(axis=0).min()
        for k in range(int(max(leave - enter, 0) / length) + 2):
            t = np.float32(enter + (k + offset[ray]) * length)
            point = origins[ray].astype(np.float32) + directions[ray].astype(np.float32) * t
            if t < leave and occupied[cell_index(point[None])[0]]:
                expected.append((ray, t))
    assert len(expected) > 40
    assert abs(len(got.ray) - len(expected)) <= 2  # a sample on a wall may be in or out by a rounding
    assert np.array_equal(np.bincount(got.ray, minlength=200)[:150] > 0, np.bincount([r for r, _ in expected], minlength=200)[:150] > 0)
    assert (np.diff(got.ray) >= 0).all() and (np.diff(got.distance)[np.diff(got.ray) == 0] > 0).all()


def test_cells_given_up_stay_given_up():
    alive = np.zeros(CELLS**3, bool)
    alive[1000:3000] = True
    occupancy = Occupancy.of_hull(alive)
    rng = np.random.default_rng(0)
    occupancy.update(lambda x: np.where(np.arange(len(x)) < 500, 0.0, 5.0).astype(np.float32), 10**6, rng)
    occupancy.prune(1.0)
    assert occupancy.occupied.sum() == 1500 and not occupancy.occupied[:1500].any()
    occupancy.update(lambda x: np.full(len(x), 9.0, np.float32), 10**6, rng)
    assert occupancy.occupied.sum() == 1500


@pytest.mark.hard_case(6)
def test_field_coordinates_far_from_the_origin():
    domain = Domain.around(np.full(3, 1e6), np.full(3, 1e6) + 2)
    points = np.full((1, 3), 1e6) + np.array([[0.001, 0.5, 1.999]])
    assert np.allclose(domain.from_world(points), [[-0.999, -0.5, 0.999]], atol=1e-6)
    assert np.allclose(domain.to_world(domain.from_world(points)), points, atol=1e-6)
