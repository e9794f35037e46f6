"""The visual hull, the occupancy grid and packed samples, against brute force."""

from fractions import Fraction

import numpy as np
import pytest

from scenes import looking, make_cameras
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.geometry.distortion import Distortion
from snerg.core.nerf.sampling import (
    CELLS,
    Domain,
    Occupancy,
    carve,
    cell_centres,
    cell_index,
    cells_alive,
    clip_rays,
    coarser,
    dilated,
    footprint,
    hull,
    pack_samples,
)

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


@pytest.mark.hard_case(42)
def test_what_a_clip_plane_hides_is_not_carved():
    """Behind the far plane, and in front of the near one, an empty picture says nothing."""
    empty, full = np.zeros((20, 20), bool), np.ones((20, 20), bool)
    one = Camera(20, 20, (20.0, 20.0), (10, 10), looking((0, -4, 0), (0, 0, 0)), near=2.5, far=4.5)
    other = Camera(20, 20, (20.0, 20.0), (10, 10), looking((4, 0, 0), (0, 0, 0)))
    points = np.array([[0, -1.6, 0], [0, -1.4, 0], [0, 0.4, 0], [0, 0.6, 0]])  # at depths of 2.4, 2.6, 4.4 and 4.6
    assert carve(points, [one, other], [empty, full], 0.01).tolist() == [True, False, False, True]
    assert carve(points, [one], [full], 0.01).tolist() == [False, True, True, False], "none sees what is hidden"


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


def exact_clip(domain: Domain, origin: np.ndarray, direction: np.ndarray) -> tuple[float, float] | None:
    """Where a ray enters and leaves the closed box, in rational arithmetic; None where it misses it."""
    enter, leave = Fraction(0), Fraction(10**9)
    for o, d, low, high in zip(origin.tolist(), direction.tolist(), domain.low.tolist(), domain.high.tolist(), strict=True):
        if abs(d) < 1e-12:  # it moves by less than any spacing of samples
            if not low <= o <= high:
                return None
            continue
        walls = sorted((Fraction(wall) - Fraction(o)) / Fraction(d) for wall in (low, high))
        enter, leave = max(enter, walls[0]), min(leave, walls[1])
    return (float(enter), float(leave)) if enter < leave else None


def hard_rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays along axes and diagonals with origins on and beside faces, edges and corners; components that are 0, -0, or denormal."""
    draw = np.random.default_rng(5)
    places = np.stack([DOMAIN.low, DOMAIN.high, np.zeros(3), 1.5 * DOMAIN.low, 1.5 * DOMAIN.high, DOMAIN.low - 1e-13, DOMAIN.high - 1e-13])
    origins = places[draw.integers(0, len(places), (count, 3)), np.arange(3)]
    some = draw.random((count, 3)) < 0.25
    origins = np.where(some, draw.uniform(-1.2, 1.2, (count, 3)), origins)
    directions = draw.choice([0.0, -0.0, 1.0, -1.0, 5e-324, -1e-310], (count, 3), p=[0.3, 0.1, 0.25, 0.25, 0.05, 0.05])
    directions[np.abs(directions).max(axis=-1) < 0.5, draw.integers(0, 3)] = 1.0
    return origins, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


@pytest.mark.hard_case(31, 32)
def test_rays_through_faces_edges_and_corners_are_clipped_as_rational_arithmetic_does():
    """1e5 rays, a twentieth of them against fractions and all of them against themselves mirrored: none is wrong, and nothing warns."""
    origins, directions = hard_rays(100_000)
    enter, leave = clip_rays(DOMAIN, origins, directions, 0.0)
    assert np.isfinite(enter).all() and np.isfinite(leave).all()
    for i in range(0, len(origins), 20):
        exact = exact_clip(DOMAIN, origins[i], directions[i])
        if exact is None:
            assert leave[i] <= enter[i], (origins[i], directions[i])
        else:
            assert enter[i] == pytest.approx(exact[0], abs=1e-12) and leave[i] == pytest.approx(exact[1], abs=1e-12), (
                origins[i],
                directions[i],
            )
    mirrored = clip_rays(DOMAIN, -origins, -directions, 0.0)  # the box is symmetric
    hit = leave > enter
    assert (
        np.array_equal(hit, mirrored[1] > mirrored[0])
        and np.allclose(enter[hit], mirrored[0][hit])
        and np.allclose(leave[hit], mirrored[1][hit])
    )


@pytest.mark.hard_case(31)
def test_a_ray_in_a_face_of_the_domain_has_all_of_its_samples():
    for side in (DOMAIN.low, DOMAIN.high, DOMAIN.high - 1e-13, DOMAIN.low + 1e-13):
        origin, direction = np.array([[-3.0, side[1], 0.2]]), np.array([[1.0, 0, -0.0]])
        got = pack_samples(DOMAIN, np.ones(CELLS**3, bool), origin, direction, 0.011, np.full(1, 0.5))
        assert len(pack_samples(DOMAIN, np.ones(CELLS**3, bool), origin, direction, 0.011, np.full(1, 0.9)).ray) == 181
        assert len(got.ray) == 182 and got.distance[0] == pytest.approx(2.0055) and got.distance[-1] == pytest.approx(3.9965)


def test_near_moves_the_beginning_of_a_ray_and_not_its_end():
    origin, direction = np.array([[-3.0, 0, 0.2]] * 2), np.array([[1.0, 0, 0]] * 2)
    enter, leave = clip_rays(DOMAIN, origin, direction, np.array([2.5, 0]))
    assert enter.tolist() == pytest.approx([2.5, 2]) and leave.tolist() == pytest.approx([4, 4])


@pytest.mark.parametrize("length", [2 / 256, 2 / 64, 2 / 32, 2 / 20, 0.3])
def test_the_coarse_grid_excludes_no_occupied_cell(length):
    """Single cells, also at the borders; segments in every direction whose middles are looked up."""
    draw = np.random.default_rng(3)
    cells = draw.integers(0, CELLS, (60, 3))
    cells[:20] = draw.choice([0, CELLS - 1], (20, 3))
    occupied = np.zeros((CELLS,) * 3, bool)
    occupied[tuple(cells.T)] = True
    targets = ((cells + draw.random((40, *cells.shape))) * (2 / CELLS) - 1).reshape(-1, 3)
    directions = draw.normal(size=targets.shape)
    directions[::7] = np.eye(3)[draw.integers(0, 3, len(directions[::7]))]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    span = 8 * length
    coarse, factor = coarser(occupied.reshape(-1), span)
    size = CELLS // factor
    for place in (-0.5, -0.4999, 0.0, 0.4999, 0.5):  # where on the segment the occupied point is
        middle = targets - place * span * directions
        index = ((middle + 1) * (size / 2)).astype(int).clip(0, size - 1)
        assert coarse[(index[:, 0] * size + index[:, 1]) * size + index[:, 2]].all()
    assert size == (64 if length == 2 / 256 else 16)


def test_occupancy_is_a_running_upper_estimate():
    """First what is measured; then the larger of that and four fifths of the old with a fifth of the new."""
    occupancy = Occupancy.of_hull(np.arange(CELLS**3) < 4)
    draw = np.random.default_rng(0)
    occupancy.update(lambda x: np.float32([2, 4, 8, 0]), 10, draw)
    assert occupancy.most[:5].tolist() == [2, 4, 8, 0, 0]
    occupancy.update(lambda x: np.float32([1, 6, 0, 0.5]), 10, draw)
    assert occupancy.most[:4] == pytest.approx([0.8 * 2 + 0.2 * 1, 6, 0.8 * 8, 0.5], rel=1e-6)


def test_no_more_cells_are_measured_than_asked_for_and_each_once():
    occupancy = Occupancy.of_hull(np.arange(CELLS**3) < 1000)
    seen = []

    def query(x):
        seen.append(x)
        return np.full(len(x), 2, np.float32)

    occupancy.update(query, 300, np.random.default_rng(0))
    assert len(seen[0]) == 300 and len(np.unique(cell_index(seen[0]))) == 300 and np.isinf(occupancy.most[:1000]).sum() == 700
    occupancy.update(query, 1000, np.random.default_rng(0))
    assert len(seen[1]) == 1000 and (occupancy.most[:1000] == 2).all()


def test_points_of_cells_lie_anywhere_in_them():
    cells = np.random.default_rng(1).integers(0, CELLS**3, 20_000)
    points = Occupancy.points_in(cells, np.random.default_rng(2))
    assert points.dtype == np.float32 and (cell_index(points) == cells).mean() > 0.9999
    place = (points.astype(np.float64) + 1) * (CELLS / 2) % 1
    for axis in range(3):
        assert np.abs(np.histogram(place[:, axis], 8, (0, 1))[0] / len(place) - 0.125).max() < 0.01
    assert np.abs(np.corrcoef(place.T) - np.eye(3)).max() < 0.03
    assert np.allclose(cell_centres(CELLS)[cells], np.round((points + 1) * 64 - 0.5) / 64 - 1 + 0.5 / 64, atol=0.6 / 64)


def test_cells_of_points_and_of_what_lies_outside():
    points = np.float32(
        [[-1, -1, -1], [1, 1, 1], [0, 0, 0], [-9, 9, 0.999], [-1 + 2 / CELLS, 0, 0], [-1 + 3.5 / CELLS, 0.75 / 64, -0.75 / 64]]
    )
    index = np.stack(np.unravel_index(cell_index(points), (CELLS,) * 3), axis=-1)
    assert index.tolist() == [[0, 0, 0], [127, 127, 127], [64, 64, 64], [0, 127, 127], [1, 64, 64], [1, 64, 63]]
    assert cell_centres(2)[[0, 1, 7]].tolist() == [[-0.5, -0.5, -0.5], [-0.5, -0.5, 0.5], [0.5, 0.5, 0.5]]


def test_a_footprint_is_rounded_up_and_bounded():
    camera = Camera(100, 80, (50.0, 60.0), (50, 40), np.eye(4))
    assert footprint(camera, np.array([4.0, 2.0, 8.0]), 0.11) == 5  # 60 * 0.11 / 2 = 3.3
    assert footprint(camera, np.array([1e-12]), 0.1) == 13 and footprint(camera, np.zeros(0), 0.1) == 1
    parallel = Camera(100, 80, (50.0, 60.0), (50, 40), np.eye(4), "orthographic")
    assert footprint(parallel, np.array([4.0]), 0.11) == 8  # 60 * 0.11 = 6.6, at any depth


def test_the_domain_fits_its_longest_side():
    domain = Domain.around(np.array([1.0, -2, 4]), np.array([3.0, 6, 5]))
    assert domain.scale == 0.25 and domain.centre.tolist() == [2, 2, 4.5]
    assert domain.low.tolist() == [-0.25, -1, -0.125] and domain.high.tolist() == [0.25, 1, 0.125]
    assert np.allclose(domain.world_box().corners().min(axis=0), [1, -2, 4])


def test_any_cell_may_be_measured():
    occupancy = Occupancy.of_hull(np.arange(CELLS**3) < 1000)
    occupancy.update(lambda x: np.ones(len(x), np.float32), 300, np.random.default_rng(0))
    measured = np.flatnonzero(~np.isinf(occupancy.most[:1000]))
    assert abs(measured.mean() - 500) < 50 and measured.max() > 950


def test_the_coarse_grid_is_that_of_the_occupancy():
    """Not that of another array that had its place in memory."""
    for cell in range(0, CELLS**3, CELLS**3 // 9):
        occupied = np.zeros(CELLS**3, bool)
        occupied[cell] = True
        coarse, factor = coarser(occupied, 0.05)
        assert np.array_equal(coarse, coarser(occupied.copy(), 0.05)[0]) and coarse.any() and factor == 1
        del occupied


def test_the_domain_holds_every_coarse_cell_of_the_hull():
    """And half a coarse cell more, where the box reaches so far."""
    cameras = [c for c in make_cameras(width=60, height=60) if c.name not in ("Inside", "Near plane", "Far plane")]
    box, masks = Box.axis_aligned([-1, -1, -1], [1, 1, 1]), balls(cameras)
    domain, _ = hull(box, cameras, masks)
    coarse = cell_centres(64)[cells_alive(Domain.around(np.full(3, -1.0), np.full(3, 1.0)), 64, box, cameras, masks)]
    corners = domain.world_box().corners()
    assert np.allclose(corners.min(axis=0), np.maximum(coarse.min(axis=0) - 1 / 32, -1))
    assert np.allclose(corners.max(axis=0), np.minimum(coarse.max(axis=0) + 1 / 32, 1))
