"""Pruning and fitting against loops in float64: shares, stencils, batches, the value of a pixel and a step of Adam."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from scenes import looking, make_snerg, random_network, snerg_from_volume
from snerg.core.baking.fit_batches import BATCH_SAMPLES, Neighbourhoods, Voxels, batch_ends, batches
from snerg.core.baking.prune import shares, without
from snerg.core.baking.ray_samples import (
    MAX_RAY_SAMPLES,
    NO_VOXEL,
    RaySamples,
    corners_of,
    own_voxels,
    sampled_views,
    stencil_weights,
)
from snerg.core.geometry.camera import Camera
from snerg.core.scene.blocks import block_coordinates


def given(lengths: list[int], base: np.ndarray, seed: int = 0) -> RaySamples:
    draw = np.random.default_rng(seed)
    towards = draw.normal(size=(len(lengths), 3))
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    first = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    fraction = draw.integers(0, 256, (len(base), 3)).astype(np.uint8)
    return RaySamples(first, base, fraction, towards.astype(np.float32), draw.integers(0, 256, (len(lengths), 4)).astype(np.uint8))


def plain_weights(fraction: np.ndarray) -> np.ndarray:
    """[8] of a sample whose position in its stencil is the middle of a 256th."""
    x, y, z = (fraction.astype(float) + 0.5) / 256
    return np.array([(x if i else 1 - x) * (y if j else 1 - y) * (z if k else 1 - z) for i, j, k in product((0, 1), repeat=3)])


@pytest.mark.hard_case(34)
def test_weights_of_a_stencil_are_trilinear_in_the_order_of_its_corners() -> None:
    fraction = np.uint8([[0, 0, 0], [255, 0, 128], [3, 200, 77]])
    got = stencil_weights(np, fraction)
    assert got == pytest.approx(np.stack([plain_weights(row) for row in fraction]), abs=1e-6)
    assert corners_of(np.array([5000]))[0].tolist() == [5000 + 1024 * i + 32 * j + k for i, j, k in product((0, 1), repeat=3)]


def test_each_voxel_of_an_apron_is_a_copy_of_its_neighbours_own() -> None:
    scene = make_snerg((61, 35, 40), diffuse=True)
    own = own_voxels(scene).reshape(-1, 32, 32, 32)
    inside = np.arange(own.size).reshape(own.shape)
    places = {tuple(place): number for number, place in enumerate(block_coordinates(scene.indirection))}
    draw = np.random.default_rng(0)
    for _ in range(2000):
        cell, x, y, z = (int(draw.integers(0, n)) for n in (len(own), 32, 32, 32))
        place = np.array(list(places)[cell]) + [(v == 31) - (v == 0) for v in (x, y, z)]
        there = places.get(tuple(place))
        local = [1 if v == 31 else 30 if v == 0 else v for v in (x, y, z)]
        assert own[cell, x, y, z] == (NO_VOXEL if there is None else inside[(there, *local)])


@pytest.mark.hard_case(18)
def test_a_voxels_share_is_light_times_opacity_times_weight() -> None:
    draw = np.random.default_rng(1)
    alpha = draw.random(32**3).astype(np.float32) ** 3
    alpha[:2000] = 1.0
    samples = given([5, 1, 7], draw.integers(0, 30000, 13))
    samples.base[2] = 100  # opaque: nothing behind it counts
    got = shares(samples, alpha)
    for ray in range(3):
        light = 1.0
        for row in range(samples.first[ray], samples.first[ray + 1]):
            corners = samples.base[row] + np.array([1024 * i + 32 * j + k for i, j, k in product((0, 1), repeat=3)])
            opacity = alpha[corners].astype(float) * plain_weights(samples.fraction[row])
            assert got[row] == pytest.approx(light * opacity, abs=2e-6)
            light *= 1 - opacity.sum()
    thin = np.full(32**3, 1e-6, np.float32)
    many = given([4000], draw.integers(0, 30000, 4000))
    assert shares(many, thin).sum(dtype=np.float64) == pytest.approx(-np.expm1(4000 * np.log1p(-1e-6)), rel=1e-5)


def test_dropped_voxels_go_from_every_apron_and_no_other_does() -> None:
    scene = make_snerg((61, 35, 40), diffuse=True)
    own = own_voxels(scene)
    dropped = np.zeros(len(own), bool)
    dropped[np.random.default_rng(0).choice(len(own), len(own) // 3, replace=False)] = True
    dropped.reshape(-1, 32**3)[0] = True  # a block whose apron alone holds something
    left = without(scene, dropped)
    expected = scene.cells.reshape(-1, 4).copy()
    expected[(own != NO_VOXEL) & dropped[own]] = 0
    expected = expected.reshape(scene.cells.shape)
    for place in np.argwhere(left.indirection >= 0):
        assert np.array_equal(left.cells[left.indirection[tuple(place)]], expected[scene.indirection[tuple(place)]])
    gone = (left.indirection < 0) & (scene.indirection >= 0)
    assert not expected[scene.indirection[gone]].any()


def test_thinning_keeps_whole_rays() -> None:
    samples = given([3, 5, 2, 4, 1, 6, 2], np.arange(23))
    assert samples.thinned(23) is samples and samples.thinned(30) is samples
    half = samples.thinned(22)
    assert half.first.tolist() == [0, 3, 5, 6, 8] and half.base.tolist() == [0, 1, 2, 8, 9, 14, 21, 22]
    assert np.array_equal(half.pixels, samples.pixels[::2]) and np.array_equal(half.fraction, samples.fraction[half.base])
    assert samples.thinned(11).first.tolist() == [0, 3, 7, 9] and len(samples.thinned(1)) == 1


def test_the_voxels_of_a_fit_are_those_that_samples_lie_next_to() -> None:
    scene = make_snerg((40, 35, 31))
    flat = scene.cells.reshape(-1, 8)
    held = np.flatnonzero(flat[:, -1])
    base = np.random.default_rng(2).choice(held[held < len(flat) - 2000], 300)
    base = base[(np.stack(np.unravel_index(base % 32**3, (32,) * 3)) < 31).all(axis=0)]
    voxels = Voxels.of(scene, given([len(base)], base))
    own = own_voxels(scene)
    near = {int(own[b + 1024 * i + 32 * j + k]) for b in base for i, j, k in product((0, 1), repeat=3)} - {NO_VOXEL}
    assert voxels.rows.tolist() == sorted(row for row in near if flat[row, -1] > 0)
    count = len(voxels.rows)
    assert len(voxels.stored) == 2**16 and np.array_equal(voxels.stored[:count], flat[voxels.rows]) and not voxels.stored[count:].any()
    empty = len(voxels.stored) - 1
    place = {int(row): number for number, row in enumerate(voxels.rows)}
    assert all(voxels.numbers[i] == place.get(int(own[i]), empty) for i in range(0, len(own), 7))
    straight = voxels.straight(255.0)
    assert straight[:count, -1] == pytest.approx(flat[voxels.rows, -1] / 255) and straight.max() <= 1
    expected = np.minimum(flat[voxels.rows, :-1] / flat[voxels.rows, -1:].astype(float), 1)
    assert np.abs(straight[:count, :-1] - expected).max() < 1e-5
    back = voxels.to_store(scene, (voxels.stored / np.float32(255)).astype(np.float32), 0)
    thick = voxels.stored[:, -1] >= 12
    assert back.dtype == np.uint8 and np.array_equal(back[thick], voxels.stored[thick])
    assert np.abs(back.astype(int) - voxels.stored)[:count].max() <= 1 and not back[count:].any()
    full = replace(scene, cells=np.full_like(scene.cells, 200))
    assert len(Voxels.of(full, given([2**5], np.arange(33, 65) + 1024)).stored) % 2**16 == 0


def test_batches_hold_every_sample_once_and_end_before_they_are_full() -> None:
    draw = np.random.default_rng(3)
    lengths = draw.integers(1, 40, 90).tolist()
    scene = make_snerg((30, 30, 30))
    samples = given(lengths, draw.integers(0, 30000, sum(lengths)))
    voxels, order, size = Voxels.of(scene, samples), draw.permutation(90), 8
    ends = list(batch_ends(samples, order, size))
    assert [a for a, _ in ends] == [0, *(b for _, b in ends[:-1])] and ends[-1][1] == 90
    for (first, end), batch in zip(ends, batches(samples, order, size, voxels), strict=True):
        rays = order[first:end]
        count = sum(lengths[ray] for ray in rays)
        assert len(rays) <= size - 1 and count <= size * BATCH_SAMPLES
        full = end == 90 or len(rays) == size - 1 or count + lengths[order[end]] > size * BATCH_SAMPLES
        assert full, "as many as have room"
        assert batch.corners.shape == (size * BATCH_SAMPLES, 8) and batch.valid.sum() == count and batch.used.sum() == len(rays)
        rows = np.concatenate([np.arange(samples.first[ray], samples.first[ray + 1]) for ray in rays])
        assert np.array_equal(batch.corners[:count], voxels.numbers[corners_of(samples.base[rows])])
        assert np.array_equal(batch.fraction[:count], samples.fraction[rows])
        assert batch.ray[:count].tolist() == [k for k, ray in enumerate(rays) for _ in range(lengths[ray])]
        assert batch.slot[:count].tolist() == [k for ray in rays for k in range(lengths[ray])]
        assert (batch.corners[count:] == len(voxels.stored) - 1).all() and (batch.ray[count:] == size - 1).all()
        assert (batch.slot[count:] == MAX_RAY_SAMPLES - 1).all() and np.array_equal(batch.pixels[: len(rays)], samples.pixels[rays])


def test_neighbourhoods_number_the_voxels_of_a_batch() -> None:
    near = Neighbourhoods(100)
    for corners in (np.array([[3, 7, 99, 3, 50, 7, 99, 99]]), np.array([[99] * 8]), np.array([[0, 98, 5, 6, 7, 8, 9, 10]])):
        rows, places = near(corners)
        assert len(rows) == 9 and np.array_equal(rows[places], corners) and places.dtype == np.int32
        known = sorted(set(corners.reshape(-1).tolist()) - {99})
        assert rows.tolist() == known + [99] * (9 - len(known))


def plain_pixel(scene_values: np.ndarray, rows: range, samples: RaySamples, network, background, correct: bool, ray: int) -> np.ndarray:
    """What a ray shows minus its pixel, in float64."""
    light, total = 1.0, np.zeros(7)
    for row in rows:
        value = plain_weights(samples.fraction[row]) @ scene_values[row]
        total += light * value[:-1]
        light *= 1 - min(max(value[-1], 0), 0.9999)
    if correct:
        opaque = 1 - light
        factor = min(1, 1.5 * opaque) / opaque if opaque else 1.5
        total, light = total * factor, 1 - factor * opaque
    colour = total[:3] + light * np.array(background)
    if light <= 254 / 255:
        d = samples.view_directions[ray].astype(np.float64)
        x = np.concatenate([d, *[f(2.0**k * d) for f in (np.sin, np.cos) for k in range(4)], total[:3] + light, total[3:]])
        a = [np.asarray(w, np.float64) for w in network]
        x = np.maximum(x @ a[0] + a[1], 0)
        x = np.maximum(x @ a[2] + a[3], 0)
        colour = colour + 1 / (1 + np.exp(-(x @ a[4] + a[5])))
    pixel = samples.pixels[ray] / 255
    return colour - pixel[:3] * pixel[3] - (1 - pixel[3]) * np.array(background)


@pytest.mark.hard_case(8, 18, 43, 53)
@pytest.mark.parametrize("correct", [False, True])
def test_what_a_pixel_is_off_by_is_that_of_float64(correct: bool) -> None:
    """Thick and thin rays, some clear; over a background; rays that only fill the batch are off by nothing."""
    jax = pytest.importorskip("jax")
    from snerg.core.baking.fit_voxels import pixel_errors

    draw, network, background = np.random.default_rng(4), random_network(3), (0.2, 0.9, 0.5)
    lengths = [3, 9, 1, 4, 2, 6]
    count = sum(lengths)
    samples = given(lengths, draw.integers(0, 30000, count))
    scene = snerg_from_volume(np.full((30, 30, 30, 8), 9, np.uint8), network, grid_to_world=np.eye(4), voxel_size=0.1)
    batch = next(batches(samples, np.arange(6), 8, Voxels.of(scene, samples)))
    alpha = draw.random((count, 8, 1)) * np.repeat([0.9, 0.3, 1e-5, 1.0, 0.0, 1e-3], lengths)[:, None, None]
    values = np.concatenate([alpha * draw.random((count, 8, 7)), alpha], axis=-1)
    corners = np.zeros((96, 8, 8), np.float32)
    corners[:count] = values
    found = np.asarray(jax.jit(pixel_errors, static_argnums=(3, 4))(corners, network, batch, background, correct))
    first = samples.first
    expected = [plain_pixel(values, range(first[r], first[r + 1]), samples, network, background, correct, r) for r in range(6)]
    assert np.abs(found[:6] - np.array(expected)).max() < 5e-6 and not found[6:].any()


def test_a_step_is_adams_and_leaves_what_no_ray_needs() -> None:
    """Two steps with numerical gradients in float64; voxels that no sample lies next to, and the empty one, stay."""
    jax = pytest.importorskip("jax")
    import jax.numpy as jnp

    from snerg.core.baking.fit_voxels import Fitted, _step, pixel_errors, premultiplied

    draw = np.random.default_rng(5)
    samples = given([2, 3], np.array([165, *draw.integers(0, 30000, 4)]))  # the first lies half outside of the scene
    diffuse = snerg_from_volume(np.full((30, 30, 30, 4), 90, np.uint8), None, grid_to_world=np.eye(4), voxel_size=0.1)
    chosen = Voxels.of(diffuse, samples)
    batch = next(batches(samples, np.arange(2), 4, chosen))
    rows, places = Neighbourhoods(len(chosen.stored))(batch.corners)
    start = np.zeros((len(chosen.stored), 4), np.float32)
    start[: len(chosen.rows)] = draw.uniform(0.2, 0.8, (len(chosen.rows), 4))
    fitted = Fitted(jnp.asarray(start), None)
    moments = jax.tree.map(jnp.zeros_like, (fitted, fitted))
    black = (0.0, 0.0, 0.0)

    def loss(values: jnp.ndarray) -> jnp.ndarray:
        corners = premultiplied(jnp, values[batch.corners])
        return (pixel_errors(corners, None, batch, black, False) ** 2).sum() / (3 * 2)

    slope, expected, m, v = jax.jit(jax.grad(loss)), start.astype(np.float64), 0.0, 0.0
    clear = np.ones(start.shape, bool)  # of gradients that single precision knows to a thousandth
    for step in (1, 2):
        gradient = np.asarray(slope(jnp.asarray(expected, jnp.float32)), np.float64)
        m, v = 0.9 * m + 0.1 * gradient, 0.99 * v + 0.01 * gradient**2
        change = (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - 0.99**step)) + 1e-9)
        expected = np.where(np.abs(gradient) > 1e-9, np.clip(expected - 0.3 * change, 0, 1), expected)
        expected[-1] = 0
        moved = batch._replace(corners=places)
        fitted, moments = _step(fitted, moments, float(step), (0.3, 0.0), rows, moved, black, False)
        clear &= (np.abs(gradient) > 1e-4) | (gradient == 0)
        assert np.abs(np.asarray(fitted.voxels) - expected)[clear].max() < 1e-3 and (gradient[clear] != 0).sum() > 50
    touched = np.zeros(len(start), bool)
    touched[rows] = True
    assert touched.sum() < len(chosen.rows) + 2 and np.array_equal(np.asarray(fitted.voxels)[~touched], start[~touched])
    assert not np.asarray(fitted.voxels)[-1].any() and np.abs(np.asarray(fitted.voxels) - start).max() > 0.2


class Views:
    """A dataset of pictures whose colours are their pixel's row and column."""

    def __init__(self, cameras: tuple[Camera, ...]) -> None:
        self.cameras, self.views = cameras, cameras

    def read(self, index: int) -> np.ndarray:
        camera = self.cameras[index]
        row, column = np.mgrid[0 : camera.height, 0 : camera.width]
        return np.stack([row, column, np.full_like(row, index)], axis=-1).astype(np.uint8)

    def mask(self, index: int) -> None:
        return None


def around(count: int) -> tuple[Camera, ...]:
    poses = [looking((3 * np.cos(0.7 * i), 3 * np.sin(0.7 * i), 0.5), (0, 0, 0)) for i in range(count)]
    return tuple(Camera(24, 15, (20.0, 20.0), (12, 7.5), pose) for pose in poses)


def test_samples_of_a_picture_that_is_no_square_have_their_own_pixels() -> None:
    scene, views = make_snerg((30, 30, 30), fog=False), Views(around(2))
    for number, samples in enumerate(sampled_views(scene, views, np.arange(2), 10**6, 0, lambda f, t: None)):
        assert (
            len(samples) > 60 and len(set(map(tuple, samples.pixels.tolist()))) == len(samples) and (samples.pixels[:, 2] == number).all()
        )
        _, directions = views.cameras[number].rays(samples.pixels[:, [1, 0]].astype(int))
        assert np.abs(samples.view_directions - directions @ scene.view_rotation.T).max() < 1e-6


def test_views_that_are_kept_out_are_not_fitted_to() -> None:
    pytest.importorskip("jax")
    from snerg.core.baking.fit_voxels import FitSettings, _recorded

    for count, kept in ((4, {2}), (12, {5}), (15, {5})):
        training, validation = _recorded(make_snerg((20, 20, 20)), Views(around(count)), FitSettings(), lambda f, t: None)
        assert set(validation.pixels[:, 2].tolist()) == kept and set(training.pixels[:, 2].tolist()) == set(range(count)) - kept


def test_the_empty_voxel_has_a_number_of_its_own() -> None:
    """Where the voxels that are fitted are as many as are counted at once."""
    scene = snerg_from_volume(np.full((64, 32, 32, 4), 50, np.uint8), None, grid_to_world=np.eye(4), voxel_size=0.1)
    own = own_voxels(scene)
    base = np.flatnonzero((own == np.arange(len(own))) & (scene.cells.reshape(-1, 4)[:, -1] > 0))
    voxels = Voxels.of(scene, given([len(base)], base))
    assert len(voxels.rows) == 2**16 and len(voxels.stored) == 2**17 and not voxels.stored[-1].any()


def test_straight_values_end_at_one() -> None:
    values = np.full((30, 30, 30, 4), 3, np.uint8)
    values[..., 0] = 4
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=0.1)
    straight = Voxels.of(scene, given([1], np.array([5000]))).straight(255.0)
    assert straight[0] == pytest.approx([1, 1, 1, 3 / 255]) and straight.max() <= 1


@pytest.mark.hard_case(51)
def test_fitted_fog_keeps_its_mean() -> None:
    scene = snerg_from_volume(np.full((30, 30, 30, 4), 3, np.uint8), None, grid_to_world=np.eye(4), voxel_size=0.1)
    own = own_voxels(scene)
    base = np.flatnonzero(own == np.arange(len(own)))
    voxels = Voxels.of(scene, given([len(base)], base))
    fitted = np.zeros(voxels.stored.shape, np.float32)
    fitted[: len(voxels.rows)] = np.float32([1.2, 1.7, 3.4, 3.4]) / 255
    stored = voxels.to_store(scene, fitted, 0)[: len(voxels.rows)].astype(float)
    assert stored.mean(axis=0) == pytest.approx([1.2, 1.7, 3.4, 3.4], abs=0.02)


def test_a_batch_may_be_just_full() -> None:
    assert list(batch_ends(given([16, 16, 16, 1], np.zeros(49, int)), np.arange(4), 4)) == [(0, 3), (3, 4)]
    assert list(batch_ends(given([1] * 10, np.zeros(10, int)), np.arange(10), 4)) == [(0, 3), (3, 6), (6, 9), (9, 10)]
    assert list(batch_ends(given([16, 16, 17, 1], np.zeros(50, int)), np.arange(4), 4)) == [(0, 2), (2, 4)]


@pytest.mark.hard_case(18, 20)
def test_fog_that_is_fitted_adds_up_and_opaque_voxels_have_finite_gradients() -> None:
    jax = pytest.importorskip("jax")
    from snerg.core.baking.fit_voxels import pixel_errors

    scene = snerg_from_volume(np.full((30, 30, 30, 4), 9, np.uint8), None, grid_to_world=np.eye(4), voxel_size=0.1)
    samples = given([250], np.full(250, 5000))
    samples.pixels[:] = 255
    batch = next(batches(samples, np.arange(1), 24, Voxels.of(scene, samples)))
    fog = np.zeros((24 * 12, 8, 4), np.float32)
    fog[..., 3] = 3.5e-8
    found = np.asarray(pixel_errors(fog, None, batch, (1.0, 1.0, 1.0), False))[0]
    assert found == pytest.approx(np.full(3, -250 * 3.5e-8), abs=6e-7)
    solid = np.ones((24 * 12, 8, 4), np.float32)
    slope = jax.grad(lambda corners: (pixel_errors(corners, None, batch, (0.0, 0.0, 0.0), False) ** 2).sum())(solid)
    assert np.isfinite(np.asarray(slope)).all()


def test_voxels_without_gradient_stay() -> None:
    """After a step that moved them: their moments are kept, and nothing goes on by itself."""
    jax = pytest.importorskip("jax")
    import jax.numpy as jnp

    from snerg.core.baking.fit_voxels import Fitted, _step

    scene = snerg_from_volume(np.full((30, 30, 30, 4), 90, np.uint8), None, grid_to_world=np.eye(4), voxel_size=0.1)
    samples = given([2, 3], np.random.default_rng(5).integers(0, 30000, 5))
    voxels = Voxels.of(scene, samples)
    batch = next(batches(samples, np.arange(2), 4, voxels))
    rows, places = Neighbourhoods(len(voxels.stored))(batch.corners)
    fitted = Fitted(jnp.asarray(voxels.straight(255.0)), None)
    moments, moved = jax.tree.map(jnp.zeros_like, (fitted, fitted)), batch._replace(corners=places)
    fitted, moments = _step(fitted, moments, 1.0, (0.1, 0.0), rows, moved, (0.0, 0.0, 0.0), False)
    before = jax.tree.map(np.array, (fitted, moments))
    nothing = moved._replace(valid=np.zeros_like(moved.valid))
    after = jax.tree.map(np.array, _step(fitted, moments, 2.0, (0.1, 0.0), rows, nothing, (0.0, 0.0, 0.0), False))
    assert before[1][0].voxels.any() and all(map(np.array_equal, jax.tree.leaves(before), jax.tree.leaves(after)))
