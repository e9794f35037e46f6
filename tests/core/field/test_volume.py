"""Volume rendering and losses: NumPy against JAX, and both against closed forms in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snerg.core.field.losses import cauchy
from snerg.core.field.networks import bounded_exp, sigmoid
from snerg.core.field.volume import composite, depth_before, opacity, optical_depth


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
    if np.isinf(density):
        density = 3e38
    value, slope = jax.value_and_grad(lambda d: opacity(jnp, optical_depth(jnp, d, jnp.float32(length))))(jnp.float32(density))
    assert np.isfinite(value) and np.isfinite(slope) and 0 <= value <= 1


@pytest.mark.hard_case(23)
@pytest.mark.parametrize("density", [0.0, 1e-6, 1e-3, 1.0, 1e5, 1e7, 1e19, 1e30])
def test_cauchy_loss_against_float64(density):
    value, slope = jax.value_and_grad(lambda d: cauchy(jnp, d))(jnp.float32(density))
    exact = np.float64(np.float32(density))
    assert value == pytest.approx(np.log1p(exact**2 / 0.5), rel=1e-6)
    assert slope == pytest.approx(2 * exact / 0.5 / (1 + exact**2 / 0.5), rel=1e-5)


@pytest.mark.hard_case(25)
def test_activations_are_monotone_and_finite():
    x = jnp.linspace(-200, 200, 4001)
    for activation in (bounded_exp, sigmoid):
        y = activation(jnp, x)
        slope = jax.vmap(jax.grad(lambda v, f=activation: f(jnp, v)))(x)
        assert np.isfinite(y).all() and np.isfinite(slope).all() and (np.diff(y) >= 0).all()
