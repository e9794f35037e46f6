"""Hierarchical sampling: against closed forms, against brute force, and on a ball that is small enough to learn in seconds."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import golden
from scenes import looking
from snerg.core.errors import SnergError
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, MlpModelConfig, init_params
from snerg.core.nerf.sampling import CELLS, Domain
from snerg.core.training import hierarchical_sampler
from snerg.core.training.config import PRESETS, TrainSettings
from snerg.core.training.hierarchical_sampler import HierarchicalSampler, rays_loss, render_rays, resampled, spread, stratified
from snerg.core.training.optimizer import train_step, zero_moments
from snerg.core.training.ray_dataset import RayDataset

HASH = HashModelConfig(HashGrid(levels=3, coarsest=4, finest=16, features=4, log2_size=11), width=16)
SMALL = TrainSettings(
    family=HASH,
    view_dependence="deferred",
    sampler="hierarchical",
    rays=64,
    coarse=16,
    fine=16,
    rate=2e-2,
    final_rate=2e-2,
    beta_2=0.99,
    sparsity=1e-4,
    alpha=0.0,
    steps=100,
)


def ball_image(camera: Camera) -> np.ndarray:
    """A ball of radius 0.6 whose colour is its normal, [H, W, 4]."""
    origins, directions = camera.rays()
    along = -(origins * directions).sum(axis=-1)
    nearest = origins + directions * along[:, None]
    depth = 0.36 - (nearest**2).sum(axis=-1)
    normal = (nearest - directions * np.sqrt(depth.clip(0))[:, None]) / 0.6
    pixels = np.concatenate([0.5 + 0.5 * normal, (depth > 0)[:, None]], axis=-1).clip(0, 1) * (depth > 0)[:, None]
    return (pixels * 255).round().astype(np.uint8).reshape(camera.height, camera.width, 4)


@pytest.fixture(scope="module")
def pool() -> RayDataset:
    eyes = [(2.4 * np.cos(turn), 2.4 * np.sin(turn), 0.8 * np.sin(2 * turn)) for turn in np.arange(6)]
    cameras = tuple(Camera(24, 24, (30.0, 30.0), (12.0, 12.0), looking(eye, (0, 0, 0))) for eye in eyes)
    domain = Domain.around(np.full(3, -0.8), np.full(3, 0.8))
    return RayDataset([ball_image(c) for c in cameras], cameras, domain)


def scheme_of(pool: RayDataset, settings: TrainSettings) -> HierarchicalSampler:
    return HierarchicalSampler(settings, pool, pool.domain, np.ones(CELLS**3, bool), np.random.default_rng(settings.seed))


def learned(pool: RayDataset, settings: TrainSettings, steps: int) -> tuple[HierarchicalSampler, dict, list[float]]:
    scheme = scheme_of(pool, settings)
    params = jax.tree.map(jnp.asarray, init_params(settings.family, settings.view_dependence, settings.hierarchy != "off", scheme.rng))
    moments, errors = zero_moments(params), []
    step = jax.jit(partial(train_step, settings, scheme.loss))
    for number in range(steps):
        params, moments, (_, told, finite) = step(params, moments, scheme.batch(params, 0.0).arrays, settings.rate, number + 1)
        assert finite
        errors.append(float(told["error"]))
    return scheme, params, errors


@pytest.mark.parametrize(
    "family", [pytest.param(HASH, marks=pytest.mark.slow), MlpModelConfig(width=32, depth=2, degrees=4)], ids=["hash", "mlp"]
)
@pytest.mark.parametrize("view", ["deferred", "diffuse", "sample", "tiny"])
def test_every_architecture_learns(pool, family, view):
    rate = 2e-2 if family is HASH else 5e-3
    settings = replace(SMALL, family=family, view_dependence=view, rate=rate, final_rate=rate)
    _, _, errors = learned(pool, settings, 40)
    assert np.mean(errors[-5:]) < 0.5 * np.mean(errors[:2])


def test_options_train_too(pool):
    options = {"distances": "disparity", "background": "random", "density_noise": 0.5, "opaque": True, "rays_at_once": 32, "alpha": 0.1}
    _, _, errors = learned(pool, replace(SMALL, **options, clip_value=0.01, clip_norm=0.01), 20)
    assert errors[-1] < errors[0]


def test_one_network_learns_alone(pool):
    """It sees just what the coarse one of two would."""
    settings = replace(SMALL, family=MlpModelConfig(width=32, depth=2, degrees=4), hierarchy="off", rate=5e-3, final_rate=5e-3)
    scheme, params, errors = learned(pool, settings, 30)
    assert np.mean(errors[-5:]) < 0.5 * np.mean(errors[:2]) and "coarse" not in params
    batch = scheme.batch(params, 0.0)
    assert batch.samples == batch.rays * settings.coarse
    (alone,) = jax.jit(partial(render_rays, settings))(params, batch.arrays)
    coarse, _ = jax.jit(partial(render_rays, settings))({**params, "coarse": params}, batch.arrays)
    assert np.abs(alone.colour - coarse.colour).max() < 1e-6


def test_a_ray_gets_the_same_samples_whatever_its_batch(pool):
    settings = replace(SMALL, density_noise=0.3)
    scheme = scheme_of(pool, settings)
    params = init_params(HASH, "deferred", True, np.random.default_rng(0))
    whole = scheme.batch(params, 0.0).arrays
    alone = {name: value if np.ndim(value) == 0 else value[20:41] for name, value in whole.items()}
    render = jax.jit(partial(render_rays, settings))
    for one, other in zip(jax.tree.leaves(render(params, alone)), jax.tree.leaves(render(params, whole)), strict=True):
        assert np.abs(np.asarray(one) - np.asarray(other)[20:41]).max() < 1e-6


def test_losses_of_parts_add_up(pool):
    settings = replace(SMALL, family=MlpModelConfig(width=8, depth=1, degrees=1), view_dependence="diffuse", alpha=0.1)
    scheme = scheme_of(pool, settings)
    params = init_params(settings.family, "diffuse", True, np.random.default_rng(0))
    whole = scheme.batch(params, 0.0).arrays
    parts = [
        {name: value if np.ndim(value) == 0 else value[rows] for name, value in whole.items()} for rows in (slice(0, 32), slice(32, 64))
    ]

    def value_and_slope(settings, batch):
        (loss, told), slope = jax.jit(jax.value_and_grad(partial(rays_loss, settings, True), has_aux=True))(params, batch)
        return [np.asarray(a) for a in jax.tree.leaves((loss, told, slope))]

    expected = value_and_slope(settings, whole)
    for found in (
        [a + b for a, b in zip(*(value_and_slope(settings, part) for part in parts), strict=True)],
        value_and_slope(replace(settings, rays_at_once=20), whole),  # 4 turns of 16
    ):
        assert all(np.abs(a - b).max() <= 1e-5 * max(np.abs(b).max(), 1e-3) for a, b in zip(found, expected, strict=True))


def test_the_sparsity_loss_is_that_of_the_evenly_spaced_samples(pool):
    """Section 4.3: of both networks, at the coarse samples; where the fine ones fall does not matter to it."""
    scheme = scheme_of(pool, SMALL)
    params = init_params(HASH, "deferred", True, np.random.default_rng(0))
    batch = scheme.batch(params, 0.0).arrays
    render = jax.jit(partial(render_rays, SMALL))
    coarse, fine = render(params, batch)
    _, other = jax.jit(partial(render_rays, replace(SMALL, fine=3)))(params, batch)
    assert np.abs(fine.sparsity - other.sparsity).max() < 1e-6
    same, twice = render(
        {"field": params["field"], "view": params["view"], "coarse": {"field": params["field"], "view": params["view"]}}, batch
    )
    assert np.abs(same.sparsity - twice.sparsity).max() < 1e-6 and np.abs(coarse.sparsity - fine.sparsity).max() > 0


@pytest.mark.hard_case(11)
def test_what_is_seen_does_not_depend_on_the_length_of_the_direction(pool):
    scheme = scheme_of(pool, SMALL)
    origins, directions, near, far, looking = pool.rays(np.arange(50))
    one = scheme._arrays(origins, directions, near, far, looking)
    other = scheme._arrays(origins, directions, near, far, looking * np.linspace(0.1, 9, 50)[:, None])
    assert np.abs(one["view_directions"] - other["view_directions"]).max() < 1e-6
    with pytest.raises(SnergError, match="direction is zero"):
        scheme._arrays(origins, directions, near, far, looking * 0)


@pytest.mark.hard_case(14)
@pytest.mark.parametrize("disparity", [False, True])
def test_distances_increase_strictly(disparity):
    draw = np.random.default_rng(0)
    near = np.float32([1e-3, 0.5, 2.0])
    far = np.float32([1.0, 1.7, 6.0])
    random = draw.random((3, 384), np.float32)
    random[:, ::2] = np.nextafter(np.float32(1), np.float32(0))
    random[:, 1::2] = 0
    for xnp in (np, jnp):
        along = np.asarray(stratified(xnp, near, far, random, disparity))
        assert (np.diff(along) > 0).all() and (along[:, 0] >= near).all() and (along[:, -1] <= far).all()


@pytest.mark.hard_case(14)
def test_disparity_wants_a_nearest_distance(pool):
    inside = Camera(24, 24, (30.0, 30.0), (12.0, 12.0), looking((0.1, 0, 0), (1, 0, 0)))
    own = RayDataset([ball_image(inside)], [inside], pool.domain)
    with pytest.raises(SnergError, match="distances=linear"):
        scheme_of(own, replace(SMALL, distances="disparity")).batch({}, 0.0)
    batch = scheme_of(own, SMALL).batch({}, 0.0).arrays
    assert (batch["far"] > batch["near"]).all()


@pytest.mark.hard_case(14)
def test_rays_that_miss_count_nothing_and_stay_finite(pool):
    scheme = scheme_of(pool, SMALL)
    params = init_params(HASH, "deferred", True, np.random.default_rng(0))
    batch = dict(scheme.batch(params, 0.0).arrays)
    batch["used"] = np.zeros_like(batch["used"])
    (loss, _), slope = jax.jit(jax.value_and_grad(scheme.loss, has_aux=True))(params, batch)
    assert loss == 0 and all(not np.asarray(g).any() for g in jax.tree.leaves(slope))


@pytest.mark.hard_case(15)
def test_small_weights_stay_small():
    """A spike of 1e-7 in 64 intervals: an absolute padding of 1e-5 gives it a share of 1.6%."""
    draws = 1_000_000
    weights = np.zeros(64, np.float32)
    weights[17] = 1e-7
    borders = np.linspace(2, 6, 65, dtype=np.float32)
    chances = spread(jnp.asarray(np.random.default_rng(0).random((1, draws), np.float32)))
    found = np.asarray(resampled(jnp.asarray(borders)[None], jnp.asarray(weights)[None], chances))[0]
    share = np.histogram(found, borders)[0] / draws
    assert divergence(share, weights.astype(np.float64) / weights.sum()) < 1e-5

    weights = np.random.default_rng(1).gamma(0.2, 1.0, 64).astype(np.float32)
    found = np.asarray(resampled(jnp.asarray(borders)[None], jnp.asarray(weights)[None], chances))[0]
    assert divergence(np.histogram(found, borders)[0] / draws, weights / weights.sum(dtype=np.float64)) < 1e-5
    assert (np.diff(found) >= 0).all() and found.min() >= 2 and found.max() <= 6


def divergence(p: np.ndarray, q: np.ndarray) -> float:
    """Jensen-Shannon."""
    middle = (p + q) / 2
    terms = [np.where(a > 0, a * np.log(np.where(a > 0, a, 1) / np.where(middle > 0, middle, 1)), 0).sum() for a in (p, q)]
    return float(sum(terms) / 2)


@pytest.mark.hard_case(15)
def test_no_weight_at_all_spreads_the_samples():
    found = np.asarray(resampled(jnp.linspace(0.0, 1, 9)[None], jnp.zeros((1, 8)), spread(jnp.full((1, 16), 0.5))))
    assert np.abs(found - (np.arange(16) + 0.5) / 16).max() < 1e-6


@pytest.mark.hard_case(16)
def test_one_weight_that_is_not_a_number_spoils_its_ray_and_the_step(pool):
    weights = jnp.ones((2, 8)).at[1, 3].set(jnp.nan)
    found = np.asarray(resampled(jnp.tile(jnp.linspace(2.0, 6, 9), (2, 1)), weights, spread(jnp.full((2, 4), 0.5))))
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()

    scheme = scheme_of(pool, SMALL)
    params = init_params(HASH, "deferred", True, np.random.default_rng(0))
    params["coarse"]["field"]["table_1"][:] = np.nan
    params = jax.tree.map(jnp.asarray, params)
    batch = scheme.batch(params, 0.0).arrays
    # A ReLU may make 0 of it on the way to the loss, in some compilations; the gradient has it all the same.
    assert not jax.jit(partial(train_step, SMALL, scheme.loss))(params, zero_moments(params), batch, 1e-2, 1)[2][2]


@pytest.mark.hard_case(17)
def test_memory_of_resampling_grows_with_the_samples_alone():
    rays, coarse, fine = 512, 192, 384
    shapes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((rays, coarse + 1), (rays, coarse), (rays, fine))]
    needed = jax.jit(resampled).lower(*shapes).compile().memory_analysis().temp_size_in_bytes
    assert needed < 40 * rays * (coarse + fine)  # a comparison of all with all needs 4 * 192 * 384 a ray


def slab_batch(rays: int) -> dict:
    towards = np.tile(np.float32([0, 0, -1]), (rays, 1))
    return {
        "origins": np.tile(np.float32([0, 0, 1]), (rays, 1)),
        "directions": towards,
        "view_directions": towards,
        "near": np.full(rays, 0.25, np.float32),
        "far": np.full(rays, 1.75, np.float32),
        "seed": np.arange(rays, dtype=np.uint32),
    }


def fog(density: float) -> dict:
    """The same density and the colour 1/2 everywhere."""
    field = jax.tree.map(np.zeros_like, init_params(HASH, "diffuse", False, np.random.default_rng(0))["field"])
    field["bias_1"][0] = np.log(density)
    return {"field": field, "coarse": {"field": field}}


@pytest.mark.hard_case(18, 19)
@pytest.mark.parametrize("density", [1e-6, 0.3, 4.0])
@pytest.mark.parametrize("distances", ["linear", "disparity"])
def test_fog_is_its_closed_form(density, distances):
    """Between near and far, not beyond: JAXNeRF's last interval of 1e10 makes the thinnest of these opaque."""
    settings = replace(SMALL, view_dependence="diffuse", distances=distances)
    for seen in jax.jit(partial(render_rays, settings))(fog(density), slab_batch(32)):
        opacity = -np.expm1(-density * 1.5)
        assert np.abs(1 - np.asarray(seen.colour, np.float64) - opacity / 2).max() < 2e-6 * max(opacity, 0.1)
        assert np.abs(np.asarray(seen.transmittance) - np.exp(-density * 1.5)).max() < 1e-6


@pytest.mark.hard_case(19)
def test_an_opaque_background_is_there_when_asked_for():
    settings = replace(SMALL, view_dependence="diffuse", opaque=True)
    for seen in jax.jit(partial(render_rays, settings))(fog(1e-6), slab_batch(8)):
        assert np.abs(np.asarray(seen.colour) - 0.5).max() < 1e-5 and np.asarray(seen.transmittance).max() < 1e-30


@pytest.mark.hard_case(20, 21, 22)
def test_of_nothing_at_all_the_loss_has_a_finite_gradient(pool):
    """Density 0 everywhere, as a dead ReLU gives: no opacity, no weights, no gradient to learn from, but no NaN either."""
    family = MlpModelConfig(width=8, depth=1, degrees=1, density="relu")
    settings = replace(SMALL, family=family, alpha=0.1)
    params = init_params(family, "deferred", True, np.random.default_rng(0))
    for field in (params["field"], params["coarse"]["field"]):
        field[1].kernel[:], field[1].bias[:] = 0, -1
    (loss, _), slope = jax.jit(jax.value_and_grad(partial(rays_loss, settings, True), has_aux=True))(
        params, scheme_of(pool, settings).batch({}, 0.0).arrays
    )
    assert np.isfinite(loss) and all(np.isfinite(g).all() for g in jax.tree.leaves(slope))


def test_fine_samples_gather_where_the_coarse_network_sees_something():
    one = slab_batch(1)
    along = stratified(jnp, one["near"], one["far"], jnp.full((1, 16), 0.5), False)
    borders = jnp.concatenate([one["near"][:, None], along[:, 1:], one["far"][:, None]], axis=-1)
    weights = jnp.zeros((1, 16)).at[0, 5].set(0.9)
    found = np.asarray(resampled(borders, weights, spread(jnp.full((1, 32), 0.5))))
    assert ((found >= borders[0, 5]) & (found <= borders[0, 6])).all()


def test_the_state_comes_back(pool):
    scheme = scheme_of(pool, SMALL)
    params = init_params(HASH, "deferred", True, np.random.default_rng(0))
    assert scheme.occupied.all()
    scheme.learn(params, 256, {})
    assert 0 < np.isfinite(scheme.occupancy.most).mean() < 1  # it looked at some
    other = scheme_of(pool, SMALL)
    other.restore(scheme.state())
    assert np.array_equal(other.occupied, scheme.occupied)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper-small", "paper"])
def test_the_presets_of_the_paper_take_a_step(pool, preset):
    settings = replace(PRESETS[preset], rays=2)
    _, _, errors = learned(pool, settings, 1)
    assert np.isfinite(errors).all()


GOLDEN = MlpModelConfig(width=8, depth=1, degrees=1)


def marched(monkeypatch, settings: TrainSettings, params: dict, batch: dict) -> list[np.ndarray]:
    """The distances [R, K] of the samples of the coarse and of the fine network."""
    march = hierarchical_sampler._march

    def distances(params, batch):
        found = []
        monkeypatch.setattr(hierarchical_sampler, "_march", lambda *of: found.append(of[3]) or march(*of))
        render_rays(settings, params, batch)
        monkeypatch.undo()
        return found

    return [np.asarray(found, np.float64) for found in jax.jit(distances)(params, batch)]


def golden_ray(settings: TrainSettings, params: dict, batch: dict, ray: int, along: np.ndarray, even: np.ndarray) -> tuple:
    """(colour [3], transmittance, sparsity) of one ray with samples at distances [K], in float64 (eqs. 2 to 8)."""
    origin, direction = batch["origins"][ray].astype(np.float64), batch["directions"][ray].astype(np.float64)
    found = [golden.raw_mlp(settings.family, params["field"], origin + direction * t) for t in along]
    density = np.array([golden.density_of(settings.family, raw) for raw, _ in found])
    ends = np.array([*along[1:], batch["far"][ray]])
    depths = density * (ends - np.array([batch["near"][ray], *along[1:]]))
    if settings.opaque:
        depths[-1] = 80
    gathered, through, _ = golden.march(depths, np.array([values for _, values in found]))
    background = batch["background"][ray] if "background" in batch else np.ones(3)
    colour = golden.shown(params["view"], gathered, through, batch["view_directions"][ray], background)
    return colour, through, np.log1p(density[even] ** 2 / 0.5).mean()


@pytest.mark.hard_case(8, 19, 23)
@pytest.mark.parametrize("options", [{}, {"opaque": True, "background": "random"}], ids=["white", "opaque, random"])
def test_the_loss_of_rays_is_that_of_float64(pool, monkeypatch, options):
    """Coarse and fine colours, sparsity of the evenly spaced samples, alpha; each summed over the rays that meet the domain."""
    settings = replace(SMALL, family=GOLDEN, rays=10, coarse=6, fine=5, sparsity=0.05, alpha=0.2, **options)
    batch = scheme_of(pool, settings).batch({}, 0.0).arrays
    batch["used"][3] = False
    batch["rays"] = np.float32(batch["used"].sum())
    params = init_params(GOLDEN, "deferred", True, np.random.default_rng(1))
    distances = marched(monkeypatch, settings, params, batch)
    assert [d.shape for d in distances] == [(10, 6), (10, 11)] and all((np.diff(d) >= 0).all() for d in distances)
    expected = error = 0.0
    for network, along in zip((params["coarse"], params), distances, strict=True):
        error = 0.0
        for ray in np.flatnonzero(batch["used"]):
            even = np.flatnonzero(np.isin(along[ray], distances[0][ray]))
            colour, through, sparsity = golden_ray(settings, network, batch, ray, along[ray], even)
            alpha = batch["target"][ray, 3] / 255
            background = batch["background"][ray] if "background" in batch else 1.0
            wanted = batch["target"][ray, :3] / 255 * alpha + (1 - alpha) * background
            error += ((colour - wanted) ** 2).mean() / batch["rays"]
            expected += (0.05 * sparsity + 0.2 * (1 - through - alpha) ** 2) / batch["rays"]
        expected += error
    loss, told = jax.jit(partial(rays_loss, settings, True))(params, batch)
    assert float(loss) == pytest.approx(expected, rel=5e-6) and float(told["error"]) == pytest.approx(error, rel=5e-6)


def test_the_coarse_network_learns_nothing_through_the_fine_samples_places(pool):
    settings = replace(SMALL, family=GOLDEN, rays=10, coarse=6, fine=5)
    batch, params = scheme_of(pool, settings).batch({}, 0.0).arrays, init_params(GOLDEN, "deferred", True, np.random.default_rng(1))
    slope = jax.jit(jax.grad(lambda p: render_rays(settings, p, batch)[1].colour.sum()))(params)
    assert all(not np.asarray(g).any() for g in jax.tree.leaves(slope["coarse"])) and any(
        np.asarray(g).any() for g in jax.tree.leaves(slope["field"])
    )


def test_jitter_fine_samples_and_noise_are_independent(pool, monkeypatch):
    """Each has a stream of its own, and each ray its own seed; another batch has other numbers."""
    settings = replace(SMALL, family=GOLDEN, rays=400, coarse=12, fine=12, density_noise=1.0)
    scheme, params = scheme_of(pool, settings), init_params(GOLDEN, "deferred", True, np.random.default_rng(1))

    def numbers(params, batch):
        found = {}
        for name in ("_uniform", "_normal"):
            draw = getattr(hierarchical_sampler, name)

            def keep(*of, draw=draw, name=name):
                return found.setdefault(f"{name} {len(found)}", draw(*of))

            monkeypatch.setattr(hierarchical_sampler, name, keep)
        render_rays(settings, params, batch)
        monkeypatch.undo()
        return found

    drawn = {}
    for turn in ("first", "second"):
        batch = scheme.batch({}, 0.0).arrays
        drawn |= {f"{name} {turn}": np.asarray(values) for name, values in jax.jit(numbers)(params, batch).items()}
    assert len(drawn) == 8 and len(np.unique(batch["seed"])) == 400
    columns = [values[:, :12].ravel() for values in drawn.values()]
    assert np.abs(np.corrcoef(columns) - np.eye(8)).max() < 0.07
    for name, values in drawn.items():
        assert np.abs(np.corrcoef(values[:, :12].T) - np.eye(12)).max() < 0.25
        if "uniform" in name:
            assert values.min() >= 0 and values.max() < 1 and abs(values.mean() - 0.5) < 0.02
        else:
            assert abs(values.mean()) < 0.05 and abs(values.std() - 1) < 0.05


def test_distances_are_those_of_float64():
    near, far, random = np.float32([0.5, 2]), np.float32([2, 3]), np.float32([[0, 0.5, 0.25, 0.75]] * 2)
    share = (np.arange(4) + random.astype(np.float64)) / 4
    for xnp in (np, jnp):
        linear = np.asarray(stratified(xnp, near, far, xnp.asarray(random), False))
        inverse = np.asarray(stratified(xnp, near, far, xnp.asarray(random), True))
        assert linear == pytest.approx(near[:, None] + (far - near)[:, None] * share, rel=1e-6)
        assert inverse == pytest.approx(1 / (1 / near[:, None] + (1 / far - 1 / near)[:, None] * share), rel=1e-6)


@pytest.mark.hard_case(15)
def test_resampling_inverts_the_distribution_of_float64():
    """Also at its ends, at chances on a step, and in intervals of weight 0, which PADDING alone reaches."""
    weights = np.array([0.0, 2, 0, 1, 1])
    borders = np.array([1.0, 2, 4, 5, 5.5, 7])
    share = (1 - 1e-5) * weights / weights.sum() + 1e-5 / 5
    steps = np.concatenate([[0], np.cumsum(share)])
    chances = np.array([0.0, 1e-6, 0.1, 0.25, 0.4999, 0.500005, 0.6, 0.75, 0.8, 0.999, np.nextafter(np.float32(1), np.float32(0))])
    expected = np.interp(chances, steps, borders)
    found = np.asarray(resampled(*(jnp.asarray(a[None], jnp.float32) for a in (borders, weights, chances))))[0]
    assert np.abs(found - expected)[[0, 2, 3, 4, 6, 7, 8, 9, 10]].max() < 2e-4 and 1 <= found[1] <= 2 and 4 <= found[5] <= 5.5
    assert np.asarray(spread(jnp.asarray([[0.0, 0.5, 0.999]])))[0] == pytest.approx([0, 0.5, 0.999667], abs=1e-5)


def test_the_hierarchical_sampler_measures_its_occupancy(pool):
    """Every 256 steps; a cell is held while its opacity over one interval is above 0.01, or it is not measured."""
    scheme = scheme_of(pool, replace(SMALL, spacing=0.5))
    scheme.occupancy.most[:] = 0.02
    scheme.occupancy.most[:3] = np.float32([0.0201, np.inf, 0])
    scheme.occupancy.cells = np.arange(0)
    for step in range(1, 256):
        scheme.learn({}, step, {})
        assert scheme.occupied.all()
    scheme.density = lambda params, x: np.zeros(len(x), np.float32)
    scheme.learn({}, 256, {})
    assert np.flatnonzero(scheme.occupied).tolist() == [0, 1]


def test_resampling_covers_the_last_interval():
    """A sum of many float32 shares is not 1: what is left of 1 belongs to the last interval, and nothing lies behind it."""
    draw = np.random.default_rng(2)
    weights = jnp.asarray(draw.random((64, 4000), np.float32))
    borders = jnp.tile(jnp.linspace(0, 1, 4001), (64, 1))
    found = np.asarray(resampled(borders, weights, jnp.full((64, 1), np.nextafter(np.float32(1), np.float32(0)))))
    assert found.min() >= 1 - 1 / 4000 and found.max() <= 1


def test_density_noise_changes_what_is_seen_and_not_its_sparsity(pool):
    settings = replace(SMALL, family=GOLDEN, rays=20, coarse=6, fine=5)
    batch, params = scheme_of(pool, settings).batch({}, 0.0).arrays, init_params(GOLDEN, "deferred", True, np.random.default_rng(1))
    plain, noisy = (jax.jit(partial(render_rays, replace(settings, density_noise=noise)))(params, batch) for noise in (0.0, 2.0))
    assert (
        np.abs(plain[0].sparsity - noisy[0].sparsity).max() < 1e-6 and np.abs(plain[0].transmittance - noisy[0].transmittance).max() > 0.05
    )


@pytest.mark.hard_case(16)
def test_an_infinite_weight_spoils_its_ray_from_its_first_sample_on():
    weights = jnp.ones((1, 8)).at[0, 5].set(jnp.inf)
    assert np.isnan(resampled(jnp.linspace(2.0, 6, 9)[None], weights, jnp.asarray([[0.0, 0.1, 0.5, 0.99]]))).all()
