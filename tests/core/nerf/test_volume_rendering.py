"""Volume rendering and losses: NumPy against JAX, and both against closed forms in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snerg.core.nerf.model import HashModelConfig, MlpModelConfig, bounded_exp, density_of, sigmoid
from snerg.core.nerf.volume_rendering import composite, composite_rows, depth_before, mean_distance, opacity, optical_depth
from snerg.core.training.losses import cauchy, softness


@pytest.fixture
def packed() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    draw = np.random.default_rng(0)
    ray = np.sort(draw.integers(0, 50, 700)).astype(np.int32)
    return draw.gamma(0.3, 1.0, 700).astype(np.float32), draw.random((700, 7)).astype(np.float32), ray


def one_by_one(depth, values, ray, rays):
    """Sample after sample, float64."""
    total, through = np.zeros((rays, values.shape[-1])), np.ones(rays)
    for d, v, r in zip(depth.astype(np.float64), values, ray, strict=True):
        total[r] += through[r] * (1 - np.exp(-d)) * v
        through[r] *= np.exp(-d)
    return total, through


@pytest.mark.hard_case(18)
@pytest.mark.parametrize("xnp", [np, jnp])
def test_compositing_is_the_sum_of_equation_5(xnp, packed):
    depth, values, ray = packed
    truth = one_by_one(depth, values, ray, 60)
    got, through, weights = composite(xnp, xnp.asarray(depth), xnp.asarray(values), xnp.asarray(ray), 60)
    assert np.abs(np.asarray(got) - truth[0]).max() < 2e-6
    assert np.abs(np.asarray(through) - truth[1]).max() < 2e-6
    assert np.asarray(weights).sum() == pytest.approx((1 - truth[1]).sum(), rel=1e-5)


@pytest.mark.parametrize("xnp", [np, jnp])
def test_depth_before_starts_anew_with_each_ray(xnp):
    depth = xnp.asarray(np.float32([1, 2, 3, 4, 5]))
    ray = xnp.asarray(np.int32([0, 0, 3, 3, 3]))
    assert np.asarray(depth_before(xnp, depth, ray)).tolist() == [0, 1, 0, 3, 7]


@pytest.mark.hard_case(18)
def test_thin_fog_adds_up():
    count = 10_000
    ray = np.zeros(count, np.int32)
    depth = np.full(count, 1e-8, np.float32)
    _, through, weights = composite(np, depth, np.ones((count, 1), np.float32), ray, 1)
    assert weights.sum(dtype=np.float64) == pytest.approx(-np.expm1(-1e-4), rel=1e-6)
    _, _, traced = composite(jnp, jnp.asarray(depth), jnp.ones((count, 1)), jnp.asarray(ray), 1)
    assert np.asarray(traced).sum(dtype=np.float64) == pytest.approx(-np.expm1(-1e-4), rel=1e-5)
    assert through[0] < 1


@pytest.mark.hard_case(20)
@pytest.mark.parametrize("density", [0.0, np.exp(-100.0), 1.0, np.exp(10.0), np.inf])
@pytest.mark.parametrize("length", [0.0, np.exp(-100.0), 1.0, np.exp(10.0)])
def test_optical_depth_and_its_gradient_are_finite(density, length):
    value, slope = jax.value_and_grad(lambda d: opacity(jnp, optical_depth(jnp, d, jnp.float32(length))))(jnp.float32(density))
    assert np.isfinite(value) and np.isfinite(slope) and 0 <= value <= 1


@pytest.mark.hard_case(66)
@pytest.mark.parametrize("xnp", [np, jnp])
@pytest.mark.parametrize("density", [np.inf, -np.inf])
def test_infinite_density_along_no_length_is_nothing(xnp, density):
    assert np.asarray(optical_depth(xnp, xnp.float32(density), xnp.float32(0))) == 0
    assert np.asarray(optical_depth(xnp, xnp.float32(density), xnp.float32(1e-3))) == (80 if density > 0 else 0)
    assert np.isnan(np.asarray(optical_depth(xnp, xnp.float32(np.nan), xnp.float32(1))))  # is found, not hidden


@pytest.mark.hard_case(65)
@pytest.mark.parametrize("xnp", [np, jnp])
@pytest.mark.parametrize("depth", [1e-8, 1e-6, 1e-4])
def test_ten_thousand_thin_samples_add_up(xnp, depth):
    """A ray of ten thousand samples between two short ones; one sum after another is off by 5e-5 of the opacity."""
    ray = np.repeat(np.int32([0, 1, 2]), (3, 10_000, 5))
    depths = np.full(len(ray), depth, np.float32)
    values = np.random.default_rng(0).random((len(ray), 2)).astype(np.float32)
    values[:, 0] = 1
    truth, _ = one_by_one(depths, values, ray, 3)
    got, _, _ = composite(xnp, xnp.asarray(depths), xnp.asarray(values), xnp.asarray(ray), 3)
    assert np.abs(np.asarray(got) / truth - 1).max() < 1e-6


@pytest.mark.hard_case(23)
@pytest.mark.parametrize("density", [0.0, 1e-6, 1e-3, 1.0, 1e5, 1e7, 1e19, 1e30])
def test_cauchy_loss_against_float64(density):
    value, slope = jax.value_and_grad(lambda d: cauchy(jnp, d))(jnp.float32(density))
    exact = np.float64(np.float32(density))
    assert value == pytest.approx(np.log1p(exact**2 / 0.5), rel=1e-6)
    assert slope == pytest.approx(2 * exact / 0.5 / (1 + exact**2 / 0.5), rel=1e-5)


@pytest.mark.hard_case(20)
@pytest.mark.parametrize("depth", [0.0, 1e-30, 1e-3, 3.0, 80.0])
def test_softness_is_none_of_a_surface_and_all_of_fog(depth):
    """64 samples that together have such an optical depth, thin and then all of it in one; with a gradient that is finite."""

    def soft(depths):
        return softness(composite(jnp, depths, jnp.ones((64, 1)), jnp.zeros(64, int), 1)[2]).sum()

    alpha = -np.expm1(-depth)
    thin, slope = jax.value_and_grad(soft)(jnp.full(64, depth / 64, jnp.float32))
    hard, steep = jax.value_and_grad(soft)(jnp.zeros(64).at[20].set(depth))
    assert hard == pytest.approx(alpha * (1 - alpha), abs=1e-6) and hard <= thin + 1e-7 <= alpha + 2e-6
    assert np.isfinite(slope).all() and np.isfinite(steep).all()


@pytest.mark.hard_case(25)
def test_activations_are_monotone_and_finite():
    x = jnp.linspace(-200, 200, 4001)
    for activation in (bounded_exp, sigmoid):
        y = activation(jnp, x)
        slope = jax.vmap(jax.grad(lambda v, f=activation: f(jnp, v)))(x)
        assert np.isfinite(y).all() and np.isfinite(slope).all() and (np.diff(y) >= 0).all()


@pytest.mark.hard_case(18)
@pytest.mark.parametrize("xnp", [np, jnp])
def test_rows_are_composited_like_packed_rays(xnp):
    draw = np.random.default_rng(3)
    depth, values = draw.gamma(0.3, 1.0, (9, 40)).astype(np.float32), draw.random((9, 40, 5)).astype(np.float32)
    truth = one_by_one(depth.ravel(), values.reshape(-1, 5), np.repeat(np.arange(9), 40), 9)
    got, through, weights = (np.asarray(a) for a in composite_rows(xnp, xnp.asarray(depth), xnp.asarray(values)))
    assert np.abs(got - truth[0]).max() < 2e-6 and np.abs(through - truth[1]).max() < 2e-6
    assert np.abs(weights.sum(axis=-1) + through - 1).max() < 2e-6  # eq. 2: what is not behind is in front


@pytest.mark.hard_case(20)
@pytest.mark.parametrize("power", [-100, -5, 5, 10])
@pytest.mark.parametrize("length", [-100, -5, 5, 10])
def test_rows_are_finite_at_every_scale(power, length):
    """16 combinations of densities and distances, e^-100 to e^10, zero lengths among them."""
    sizes = jnp.array([[0.0, 1, 0, 1, 1]], jnp.float32) * np.float32(np.exp(np.float64(length)))

    def seen(density):
        depth = optical_depth(jnp, density * jnp.ones((1, 5)) * np.float32(np.exp(np.float64(power))), sizes)
        gathered, through, _ = composite_rows(jnp, depth, jnp.ones((1, 5, 1)))
        return gathered.sum() + through.sum()

    value, slope = jax.value_and_grad(seen)(jnp.float32(1))
    assert value == pytest.approx(1, abs=1e-5) and np.isfinite(slope)


@pytest.mark.hard_case(21)
@pytest.mark.parametrize("inverse", [False, True], ids=["distance", "disparity"])
def test_distance_and_disparity_of_nothing_have_a_gradient(inverse):
    def measure(gathered, alpha):
        distance = mean_distance(jnp, gathered, alpha, 1e6)
        return 1 / distance if inverse else distance

    for gathered, alpha in ((0.0, 0.0), (1e-30, 1e-30), (2.0, 0.5)):
        assert np.isfinite(jax.grad(measure, argnums=(0, 1))(jnp.float32(gathered), jnp.float32(alpha))).all()
    assert mean_distance(np, np.float32(2), np.float32(0.5)) == 4 and mean_distance(np, np.float32(0), np.float32(0)) == np.inf


@pytest.mark.hard_case(25)
@pytest.mark.parametrize("family", [HashModelConfig(), MlpModelConfig()], ids=["exponential", "softplus"])
def test_densities_are_monotone_and_finite(family):
    raw = jnp.linspace(-200, 200, 801)
    density = np.asarray(density_of(jnp, family, raw))
    slope = np.asarray(jax.vmap(jax.grad(lambda r: density_of(jnp, family, r)))(raw))
    assert np.isfinite(density).all() and np.isfinite(slope).all() and (np.diff(density) >= 0).all() and (slope > 0)[raw > -80].all()
    assert np.abs(density - np.asarray(density_of(np, family, np.asarray(raw)))).max() <= 1e-5 * density.max()


@pytest.mark.hard_case(20)
@pytest.mark.parametrize(
    ("density", "length", "expected"), [(3e38, 10.0, 80), (81.0, 1.0, 80), (-3.0, 2.0, 0), (-3e38, 10.0, 0), (0.25, 3.0, 0.75)]
)
def test_optical_depth_is_held_between_0_and_80(density, length, expected):
    with np.errstate(over="ignore"):
        assert optical_depth(np, np.float32(density), np.float32(length)) == expected
    value, slope = jax.value_and_grad(lambda d: optical_depth(jnp, d, jnp.float32(length)))(jnp.float32(density))
    assert value == expected and slope == (length if 0 < expected < 80 else 0)


@pytest.mark.hard_case(18)
def test_opacity_of_thin_and_thick_intervals():
    depth = np.float32([1e-30, 1e-9, 1e-4, 0.5, 20, 80])
    for xnp in (np, jnp):
        assert np.asarray(opacity(xnp, xnp.asarray(depth))) == pytest.approx(-np.expm1(-depth.astype(np.float64)), rel=3e-7)


def test_a_float32_sum_is_not_enough_before_a_far_sample():
    """2^20 samples, ray after ray: in NumPy no ray's depth may be a difference of large float32 sums."""
    depth = np.full(2**20, 0.3, np.float32)
    ray = np.arange(2**20) // 64
    before = depth_before(np, depth, ray)
    assert np.abs(before - np.tile(np.arange(64) * 0.3, 2**14)).max() < 5e-5 and before.dtype == np.float32


@pytest.mark.hard_case(21)
def test_where_nothing_is_seen_there_is_no_distance():
    """The bound is 1e-6 of alpha, and the distance just above it is right."""
    for alpha, seen in ((1e-6, False), (1.1e-6, True), (0.5, True)):
        found = mean_distance(np, np.float32(3 * alpha), np.float32(alpha), -1.0)
        assert found == pytest.approx(3 if seen else -1, rel=1e-6)


@pytest.mark.hard_case(25)
def test_the_bounded_exponential_and_its_slope():
    """exp from -15 to 10; beyond, the value and the slope at the bound, so that a density that drifted past it comes back."""
    x = np.float32([-100, -15, -14, 0, 2.5, 9.9, 10, 50])
    held = np.exp(np.clip(x.astype(np.float64), -15, 10))
    assert np.asarray(bounded_exp(np, x)) == pytest.approx(held, rel=1e-6)
    value, slope = jax.vmap(jax.value_and_grad(lambda v: bounded_exp(jnp, v)))(jnp.asarray(x))
    assert np.asarray(value) == pytest.approx(held, rel=1e-6) and np.asarray(slope) == pytest.approx(held, rel=1e-6)


@pytest.mark.hard_case(24)
def test_densities_of_each_kind_against_float64():
    raw = np.float32([-60, -5, -1, 0, 0.5, 3, 40])
    exact = raw.astype(np.float64)
    for xnp in (np, jnp):
        x = xnp.asarray(raw)
        assert np.asarray(density_of(xnp, MlpModelConfig(), x)) == pytest.approx(8 * np.log1p(np.exp(exact + 1)), rel=1e-6)
        assert np.asarray(density_of(xnp, MlpModelConfig(density="relu"), x)).tolist() == np.maximum(raw, 0).tolist()
        assert np.asarray(sigmoid(xnp, x)) == pytest.approx(1 / (1 + np.exp(-exact.clip(-30, 30))), rel=1e-6)


def test_softness_and_its_slope():
    for w in (0.0, 0.25, 0.5, 1.0):
        value, slope = jax.value_and_grad(softness)(jnp.float32(w))
        assert value == pytest.approx(w * (1 - w)) and slope == pytest.approx(1 - 2 * w)
