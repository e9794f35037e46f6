"""The marcher against the plain float64 one, and against closed forms."""

import time
from dataclasses import replace

import numpy as np
import pytest

from oracle import dense_march, dense_rays
from scenes import (
    empty_snerg,
    looking,
    make_cameras,
    make_forward,
    make_forward_cameras,
    make_snerg,
    random_network,
    random_scene,
    rotation,
    snerg_from_volume,
)
from snerg.core.errors import Cancelled
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.geometry.distortion import Distortion
from snerg.core.nerf.frame import Composited
from snerg.core.nerf.model import ViewNetwork, view_residual
from snerg.core.rendering.acceleration import acceleration_of, chebyshev_distance
from snerg.core.rendering.early_termination import error_bound, premultiplied_excess, residual_bound, stop_transmittance_for
from snerg.core.rendering.opacity import correct_opacity
from snerg.core.rendering.render import FIRST_PIXELS, MarchSettings, march_rays, render_progressively, render_scene, tiled_pixels

ANGLES = (0.4, -0.3, 0.8)
CENTRE = (0.3, -0.2, 0.1)
ROUNDING = 2e-5  # of single precision, amplified by the network
LENSES = (Distortion("opencv", (-0.25, 0.06, 0.002, -0.003)), Distortion("fisheye", (0.05, -0.02, 0.004, 0.0)))


def small_cameras(centre=CENTRE):
    """One of each kind, and one behind each kind of lens."""
    cameras = make_cameras(centre, width=48, height=36)
    return (*cameras, *(replace(cameras[1], distortion=lens, name=lens.model) for lens in LENSES))


@pytest.mark.hard_case(2, 3, 33, 34, 36, 37, 42, 43)
@pytest.mark.parametrize("diffuse", [False, True])
@pytest.mark.parametrize("index", range(8))
def test_equals_the_dense_march(diffuse, index):
    scene = make_snerg(diffuse=diffuse, angles=ANGLES, centre=CENTRE)
    camera = small_cameras()[index]
    got, truth = render_scene(scene, camera), dense_march(scene, camera)
    assert np.abs(1 - got.alpha - truth.transmittance).max() < 1e-4
    assert np.abs(got.over() - truth.over()).max() < 1e-4
    seen = got.alpha > 0.01
    assert np.abs(got.depth[seen] - truth.depth[seen]).max() < 1e-2


@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("projection", ["equirectangular", "fisheye"])
def test_wide_cameras_equal_the_dense_march(projection, inside):
    """Rays of one tile go apart, to all sides at a pole, also from inside of the scene; depth is along the ray."""
    scene = make_snerg(angles=ANGLES, centre=CENTRE)
    pose = looking((0.4, -0.1, 0.2) if inside else (0.5, -2.2, 0.9), CENTRE)
    if projection == "equirectangular":
        camera = Camera(48, 24, panorama_focal(48, 24), (24, 12), pose, projection)
    else:
        camera = Camera(32, 32, (8.5, 9.0), (15, 16.5), pose, projection, distortion=LENSES[1])
    got, truth = render_scene(scene, camera), dense_march(scene, camera)
    assert got.alpha.max() > 0.5
    assert np.abs(1 - got.alpha - truth.transmittance).max() < 1e-4
    assert np.abs(got.over() - truth.over()).max() < 1e-4
    seen = got.alpha > 0.01
    assert np.abs(got.depth[seen] - truth.depth[seen]).max() < 1e-2


def test_a_fisheye_shows_nothing_outside_of_its_circle_and_clips_along_its_rays():
    scene = make_snerg(angles=ANGLES, centre=CENTRE)
    camera = Camera(40, 40, (13.0, 13.0), (20, 20), looking((0.3, -0.2, 0.2), CENTRE), "fisheye")
    whole, circle = render_scene(scene, camera), render_scene(scene, replace(camera, widest=1.0))
    inside = replace(camera, widest=1.0).valid_pixels()
    assert (
        np.array_equal(circle.alpha[inside], whole.alpha[inside]) and circle.alpha[~inside].max() == 0 and whole.alpha[~inside].max() > 0.5
    )
    near = render_scene(scene, replace(camera, near=0.4, far=0.8))
    assert near.depth[near.alpha > 0.01].min() > 0.39 and near.depth[near.alpha > 0.01].max() < 0.81


@pytest.mark.hard_case(33, 36)
@pytest.mark.parametrize("axis", range(3))
def test_equals_the_dense_march_a_thousand_voxels_long(axis):
    """Rays that go the whole length of a grid, through fog at both ends, and across it."""
    shape = np.roll((1010, 24, 28), axis)
    values = np.zeros((*shape, 8), np.uint8)
    ends = np.moveaxis(values, axis, 0)
    draw = np.random.default_rng(axis)
    for part in (ends[:40], ends[-70:]):
        alpha = draw.integers(0, 30, part.shape[:3])
        part[..., 7] = alpha
        part[..., :7] = np.rint(draw.random((*alpha.shape, 7)) * alpha[..., None])
    pose = np.eye(4)
    pose[:3, 3] = -shape / 2 / 100
    scene = snerg_from_volume(values, random_network(axis), grid_to_world=pose, voxel_size=0.01)
    ahead, aside = np.roll((-5.6, 0.03, 0.02), axis), np.roll((4.8, 0.6, 0.3), axis)
    for eye, target, focal in ((ahead, (0, 0, 0), 900.0), (aside, np.roll((4.9, 0, 0), axis), 30.0)):
        camera = Camera(20, 16, (focal, focal), (10, 8), looking(tuple(eye), tuple(target)))
        got, truth = render_scene(scene, camera), dense_march(scene, camera)
        assert got.alpha.max() > 0.5
        assert np.abs(1 - got.alpha - truth.transmittance).max() < 1e-4
        assert np.abs(got.over() - truth.over()).max() < 1e-4


@pytest.mark.hard_case(64)
@pytest.mark.parametrize("length", [2000, 4090])
def test_equals_the_dense_march_at_the_longest_grids(length):
    """Positions in single precision are 2e-4 voxels apart at 2000 voxels: pictures were 1.2e-4 off, and depth 0.08 voxels."""
    values = np.zeros((length, 12, 14, 8), np.uint8)
    draw = np.random.default_rng(length)
    far = values[-60:]
    alpha = draw.integers(0, 256, far.shape[:3]) * (draw.random(far.shape[:3]) < 0.2)
    far[..., 7], far[..., :7] = alpha, np.rint(draw.random((*alpha.shape, 7)) * alpha[..., None])
    pose = np.eye(4)
    pose[:3, :3] = rotation(ANGLES)
    pose[:3, 3] = -pose[:3, :3] @ np.array(values.shape[:3]) / 2
    scene = snerg_from_volume(values, random_network(1), grid_to_world=pose, voxel_size=1.0)
    eye = pose[:3, :3] @ [-0.55 * length, 3.0, 2.0]
    camera = Camera(16, 12, (0.8 * length,) * 2, (8, 6), looking(tuple(eye), (0, 0, 0)))
    got, truth = render_scene(scene, camera, MarchSettings(tolerance=0)), dense_march(scene, camera)
    assert got.alpha.max() > 0.5 and np.where(got.alpha > 0, got.depth, 0).max() > 0.9 * length
    assert np.abs(1 - got.alpha - truth.transmittance).max() < 2e-6  # in single precision 2e-5 here
    assert np.abs(got.over() - truth.over()).max() < 3e-6
    seen = got.alpha > 0.1
    assert np.abs(got.depth[seen] - truth.depth[seen]).max() < 1e-3  # voxels


@pytest.mark.hard_case(70)
@pytest.mark.parametrize("scale", [1, 10])
@pytest.mark.parametrize("seed", range(4))
def test_a_network_that_amplifies_rounding_stays_within_the_tolerance(seed, scale):
    draw = np.random.default_rng(seed)
    scene = random_scene(draw, diffuse=False, opacity_correction=seed % 2 == 0, above=False)
    scene = replace(scene, network=ViewNetwork(*(np.float32(scale) * a for a in scene.network)))
    for camera in make_cameras(size=2.0, width=24, height=18):
        assert np.abs(render_scene(scene, camera).over() - dense_march(scene, camera).over()).max() < error_bound(
            MarchSettings().tolerance, scene
        )


@pytest.mark.hard_case(33, 34)
def test_composited_values_equal_the_dense_march():
    scene = make_snerg(angles=ANGLES, centre=CENTRE)
    origins, directions = small_cameras()[1].rays()
    values, through, _ = dense_rays(scene, origins, directions, 0.0)
    got = march_rays(scene, origins, directions)
    assert np.abs(got.colour - values[:, :3]).max() < 1e-4
    assert np.abs(got.features - values[:, 3:]).max() < 1e-4
    assert np.abs(got.transmittance - through).max() < 1e-4


@pytest.mark.hard_case(33)
def test_skipping_changes_nothing():
    scene = make_snerg(angles=ANGLES, centre=CENTRE)
    for camera in small_cameras():
        with_skip, without = render_scene(scene, camera), render_scene(scene, camera, MarchSettings(skip=False))
        assert np.abs(with_skip.colour - without.colour).max() < 1e-6
        assert np.abs(with_skip.alpha - without.alpha).max() < 1e-6


@pytest.mark.hard_case(35)
def test_a_ray_does_not_depend_on_its_batch():
    scene = make_snerg(angles=ANGLES, centre=CENTRE)
    camera = small_cameras()[0]
    whole, split = render_scene(scene, camera), render_scene(scene, camera, MarchSettings(batch=37, threads=1))
    assert np.array_equal(whole.colour, split.colour)
    assert np.array_equal(whole.alpha, split.alpha)
    donated = render_scene(scene, camera, MarchSettings(batch=37, threads=3))
    assert np.array_equal(whole.colour, donated.colour) and np.array_equal(whole.depth, donated.depth)


@pytest.mark.hard_case(35)
def test_many_rays_are_what_their_parts_are():
    """More rays than a thread clips at once and marches together; the samples of all are counted."""
    scene = make_snerg((44, 40, 57), angles=ANGLES, centre=CENTRE)
    camera = make_cameras(CENTRE)[0].resized(240, 200)
    rays = camera.rays(tiled_pixels(240, 200))
    whole = march_rays(scene, *rays)
    parts = [march_rays(scene, *(values[start : start + 6400] for values in rays)) for start in range(0, len(rays[0]), 6400)]
    assert len(rays[0]) > 2 * 16384
    assert np.array_equal(whole.colour, np.concatenate([part.colour for part in parts]))
    assert np.array_equal(whole.depth, np.concatenate([part.depth for part in parts]))
    assert whole.samples == sum(part.samples for part in parts) > len(rays[0])


@pytest.mark.hard_case(6)
def test_far_from_the_origin_is_the_same_picture():
    far = (1e6, -1e6, 1e6)
    near_frame = render_scene(make_snerg(angles=ANGLES), small_cameras((0, 0, 0))[1])
    far_frame = render_scene(make_snerg(angles=ANGLES, centre=far), small_cameras(far)[1])
    assert np.abs(near_frame.over() - far_frame.over()).max() < 1 / 255


@pytest.mark.hard_case(31, 32)
def test_axis_parallel_rays_through_faces_edges_and_corners_are_finite():
    scene = make_snerg()
    low, high = scene.box.size / -2, scene.box.size / 2
    draw = np.random.default_rng(0)
    count = 2000
    origins = draw.choice([-3.0, 3.0, low[0], high[0], 0.0], (count, 3))
    directions = draw.choice([-1.0, 0.0, 1.0, -0.0, 1e-310], (count, 3))
    directions[np.abs(directions).max(axis=-1) < 1] = [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    got = march_rays(scene, origins, directions)
    truth = dense_rays(scene, origins, np.where(np.abs(directions) < 1e-12, 0, directions), 0.0)
    assert np.isfinite(got.colour).all()
    # A ray exactly in the plane of a face may be in or out by a rounding; all others must agree.
    differs = np.abs(got.transmittance - truth[1]) > 1e-4
    assert differs.mean() < 0.01


@pytest.mark.hard_case(39)
def test_a_slab_is_as_thick_as_it_is_in_the_world():
    values = np.zeros((60, 60, 60, 4), np.uint8)
    values[..., 3] = 26
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=0.01)
    got = march_rays(scene, np.array([[0.3, 0.3, -1]]), np.array([[0.0, 0, 1]]))
    # 60 samples a voxel apart; the first and last stand on the outer voxels' centres.
    assert got.transmittance[0] == pytest.approx((1 - 26 / 255) ** 60, rel=1e-3)


@pytest.mark.hard_case(53)
def test_opacity_correction_is_finite_continuous_and_at_most_opaque():
    alpha = np.concatenate([[0.0, 1e-30], np.linspace(1e-6, 1, 3001)]).astype(np.float32)
    colour = np.stack([alpha, 0.5 * alpha, 0 * alpha], axis=-1)
    with np.errstate(all="raise", under="ignore"):
        got = correct_opacity(Composited(colour, colour[:, :0], 1 - alpha, 2 * alpha))
    opaque = 1 - got.transmittance
    assert (got.transmittance >= 0).all() and np.abs(opaque - np.minimum(1, 1.5 * alpha)).max() < 1e-6
    assert (np.diff(opaque) > -1e-6).all() and np.diff(opaque[1:]).max() < 1e-3
    assert np.abs(got.colour - opaque[:, None] * [1, 0.5, 0]).max() < 1e-6, "the colour stays that of what is there"
    assert np.abs(got.depth - 2 * opaque).max() < 1e-6


@pytest.mark.hard_case(40)
@pytest.mark.parametrize("projection", ["orthographic", "perspective"])
def test_a_camera_at_any_distance_reaches_the_scene(projection):
    """1e9 voxels away a distance that grows by 1 in single precision would stand still."""
    scene = make_snerg(shape=(34, 30, 40), diffuse=True)
    frames = []
    for distance in (10.0, 1e9 * scene.voxel_size):
        focal = 5.0 if projection == "orthographic" else 5.0 * distance
        camera = Camera(12, 12, (focal,) * 2, (6, 6), looking((0, -distance, 0), (0, 0, 0)), projection)
        frames.append(render_scene(scene, camera))
        seen = frames[-1].alpha > 0.5
        assert seen.any() and np.abs(frames[-1].depth[seen] - distance).max() < 1.5 + 3e-7 * distance
    if projection == "orthographic":
        assert np.abs(frames[0].over() - frames[1].over()).max() < 1 / 255


def test_depth_of_a_wall():
    values = np.zeros((60, 60, 60, 4), np.uint8)
    values[:, :, 30:, :] = 255
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=0.01)
    camera = Camera(
        3, 3, (1e3, 1e3), (1.5, 1.5), np.diag([1.0, -1, -1, 1]) + np.array([[0, 0, 0, 0.3], [0, 0, 0, 0.3], [0, 0, 0, -1], [0] * 4])
    )
    frame = render_scene(scene, camera)
    assert frame.alpha[1, 1] == pytest.approx(1, abs=1e-4)
    assert frame.depth[1, 1] == pytest.approx(1.3, abs=0.011)


@pytest.mark.hard_case(57)
def test_an_empty_scene_is_an_empty_picture():
    scene = replace(empty_snerg())
    frame = render_scene(scene, make_cameras(width=16, height=12)[0])
    assert not frame.alpha.any() and not frame.colour.any() and np.isinf(frame.depth).all()
    assert (frame.over() == 1).all()


@pytest.mark.parametrize("diffuse", [False, True])
def test_cells_of_floats_are_marched_as_they_are(diffuse):
    scene = make_snerg((44, 40, 57), diffuse)
    floats = replace(scene, cells=(scene.cells / np.float32(255)).astype(np.float32) ** np.float32(1.3))
    for camera in small_cameras((0, 0, 0))[1:4]:
        got, truth = render_scene(floats, camera), dense_march(floats, camera)
        assert got.alpha.max() > 0.5 and np.abs(1 - got.alpha - truth.transmittance).max() < 1e-4
        assert np.abs(got.over() - truth.over()).max() < 1e-4


def test_the_network_at_every_sample():
    """Table 1's ablation is another picture than the deferred one, and exact too."""
    scene = make_snerg((44, 40, 57), angles=ANGLES, centre=CENTRE)
    for camera in small_cameras()[:4]:
        got = render_scene(scene, camera, MarchSettings(per_sample_network=True))
        truth = dense_march(scene, camera, per_sample_network=True)
        assert np.abs(got.over() - truth.over()).max() < 1e-4
        assert np.abs(got.over() - render_scene(scene, camera).over()).max() > 0.005
        assert np.abs(got.alpha - render_scene(scene, camera).alpha).max() < 1e-4


@pytest.mark.parametrize("seed", range(12))
def test_no_pixel_is_off_by_more_than_the_tolerance(seed):
    draw = np.random.default_rng(seed)
    scene = random_scene(draw, diffuse=seed % 2 == 0, opacity_correction=seed % 3 == 0, above=seed % 4 == 1)
    camera = make_cameras(size=2.0, width=24, height=18)[seed % 5]
    for per_sample in (False, True):
        truth = dense_march(scene, camera, per_sample and scene.network is not None)
        for tolerance in (1e-3, 0.02, 0.2):
            frame = render_scene(scene, camera, MarchSettings(tolerance, per_sample_network=per_sample))
            for background in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2, 0.9, 0.5)):
                error = np.abs(np.clip(frame.over(background), 0, 1) - truth.over(background)).max()
                assert error < tolerance + ROUNDING


def test_tolerance_follows_the_scene():
    """A network that multiplies what it is given asks for more of the ray; colours above their opacity do, too."""
    scene = make_snerg((34, 30, 40), fog=False)
    mild = replace(scene, network=ViewNetwork(*(0.01 * a for a in scene.network)))
    strong = replace(scene, network=ViewNetwork(*(3 * a for a in scene.network)))
    stops = [stop_transmittance_for(0.01, scene, False) for scene in (mild, scene, strong)]
    assert 0.0098 < stops[0] <= 0.01 and stops[0] > 2 * stops[1] > 10 * stops[2]
    bright = replace(scene, cells=np.where(scene.cells > 0, 255, scene.cells[..., 7:]).astype(np.uint8))
    assert (
        premultiplied_excess(scene) < 1.02
        and premultiplied_excess(replace(bright, cells=bright.cells // np.array([1] * 7 + [2], np.uint8))) > 1.9
    )


@pytest.mark.parametrize("network", range(5))
def test_the_residual_changes_by_at_most_its_bound(network):
    draw = np.random.default_rng(network)
    weights = random_network(network)
    for low, high in ((np.array([-1.0] * 3 + [0.0] * 4), np.array([0.0] * 3 + [1.0] * 4)), (-np.ones(7), np.ones(7))):
        x, change = draw.random((4000, 7)), 0.01 * draw.uniform(low, high, (4000, 7))
        towards = draw.normal(size=(4000, 3))
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        here, there = (view_residual(np, weights, v[:, :3], v[:, 3:], towards) for v in (x, x + change))
        assert np.abs(there - here).max() < 0.01 * residual_bound(weights, low, high)


def test_the_first_picture_is_a_small_one_and_the_last_is_whole():
    scene, camera = make_snerg((34, 30, 40)), small_cameras((0, 0, 0))[1].resized(50, 37)
    told = []
    first, last = render_progressively(scene, camera, progress=lambda fraction, what: told.append(fraction))
    assert first.alpha.shape == (10, 13) and np.array_equal(first.colour, render_scene(scene, camera.resized(13, 10)).colour)
    assert np.array_equal(last.colour, render_scene(scene, camera).colour) and np.array_equal(last.depth, render_scene(scene, camera).depth)
    assert told == sorted(told) and told[-1] == pytest.approx(1)


@pytest.mark.parametrize(("size", "first"), [((4000, 3000), (200, 150)), ((20000, 600), (1000, 30))])
def test_the_first_picture_of_a_large_one_has_few_pixels(size, first):
    scene, camera = make_snerg((34, 30, 40), diffuse=True), small_cameras((0, 0, 0))[0].resized(*size)
    shape = next(render_progressively(scene, camera)).alpha.shape
    assert shape == first[::-1] and shape[0] * shape[1] <= FIRST_PIXELS


def test_a_march_stops_when_it_is_told_to():
    """Within a few passes, not after the picture: the threads ask."""
    scene, camera = make_snerg((34, 30, 40), diffuse=True), small_cameras((0, 0, 0))[0].resized(1000, 1000)
    began = time.perf_counter()
    render_scene(scene, camera)
    whole = time.perf_counter() - began

    def stop(fraction: float, what: str) -> None:
        raise Cancelled("Stopped.")

    began = time.perf_counter()
    with pytest.raises(Cancelled):
        render_scene(scene, camera, progress=stop)
    assert time.perf_counter() - began < max(0.6 * whole, 0.2)


def test_every_pixel_is_in_a_tile():
    for width, height in ((1, 1), (8, 8), (19, 9)):
        pixels = tiled_pixels(width, height)
        assert len(pixels) % 64 == 0 and {tuple(p) for p in pixels} == set(np.ndindex(width, height))
        assert all(np.ptp(tile, axis=0).max() < 8 for tile in pixels.reshape(-1, 64, 2))


def test_packets_of_incoherent_rays_are_marched_as_well():
    """Rays in random order: those of a packet are far apart."""
    scene = make_snerg(angles=ANGLES, centre=CENTRE)
    origins, directions = (np.concatenate(both) for both in zip(*(c.rays() for c in small_cameras()), strict=True))
    order = np.random.default_rng(0).permutation(len(origins))[:3001]
    mixed, plain = (march_rays(scene, origins[order], directions[order], MarchSettings(skip=skip)) for skip in (True, False))
    assert np.abs(mixed.colour - plain.colour).max() < 1e-6 and np.abs(mixed.transmittance - plain.transmittance).max() < 1e-6


def test_progress_can_cancel():
    def stop(fraction: float, what: str) -> None:
        raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        render_scene(make_snerg(), small_cameras()[0], progress=stop)


def test_chebyshev_distance():
    occupied = np.zeros((9, 9, 9), bool)
    occupied[4, 4, 4] = True
    x, y, z = np.indices(occupied.shape)
    expected = np.maximum(np.maximum(abs(x - 4), abs(y - 4)), abs(z - 4))
    assert np.array_equal(chebyshev_distance(occupied, 10), expected)
    assert chebyshev_distance(occupied, 2).max() == 2


def test_visited_voxels_are_the_blocks_own():
    scene = make_snerg(diffuse=True)
    visited = np.zeros(len(acceleration_of(scene).voxels), bool)
    origins, directions = small_cameras((0, 0, 0))[0].rays()
    march_rays(scene, origins, directions, visited=visited)
    cells = visited.reshape(-1, 32, 32, 32)
    assert cells.any() and cells[:, 1:-1, 1:-1, 1:-1].sum() == cells.sum()


@pytest.mark.parametrize("ndc", [False, True])
def test_what_two_clip_planes_cut_apart_is_the_whole(ndc):
    scene = replace(make_forward(), opacity_correction=False) if ndc else make_snerg((34, 30, 40), fog=False)
    camera = make_forward_cameras(scene.ndc)[1] if ndc else make_cameras(width=48, height=36)[0]
    whole = render_scene(scene, camera)
    cosines = (camera.rays()[1] @ -camera.camera_to_world[:3, 2]).reshape(camera.height, camera.width)
    axis_depth = whole.depth * cosines
    cut = float(np.median(axis_depth[whole.alpha > 0.5]))
    front, back = (render_scene(scene, replace(camera, near=near, far=far)) for near, far in ((0.0, cut), (cut, 1e6)))
    assert (front.alpha > 0.1).mean() > 0 and (back.alpha > 0.1).mean() > 0
    assert (front.depth * cosines)[front.alpha > 0].max() <= cut * (1 + 1e-5)
    assert (back.depth * cosines)[back.alpha > 0].min() >= cut * (1 - 1e-5)
    assert np.abs(1 - (1 - front.alpha) * (1 - back.alpha) - whole.alpha).mean() < 0.02
