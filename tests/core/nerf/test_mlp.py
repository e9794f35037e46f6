"""The paper's field, against the formulas in float64 and against JAX."""

import numpy as np
import pytest

from snerg.core.nerf.mlp import init_trunk, layer_shapes, mlp_field, positional_encoding, trunk
from snerg.core.nerf.model import view_encoding


def oracle_encoding(points: np.ndarray, degrees: int) -> np.ndarray:
    """One number at a time, in float64."""
    rows = []
    for point in points.astype(np.float64):
        row = list(point)
        for turn in (np.sin, np.cos):
            row += [turn(2.0**k * x) for k in range(degrees) for x in point]
        rows.append(row)
    return np.array(rows)


@pytest.mark.hard_case(12)
def test_encoding_is_a_sine_and_a_cosine():
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)).astype(np.float32)
    assert np.abs(positional_encoding(np, points, 10) - oracle_encoding(points, 10)).max() < 1e-6


@pytest.mark.hard_case(13)
def test_encoding_is_finite_far_out():
    points = np.float32([[1e10, -1e10, 1e3]])
    encoded = positional_encoding(np, points, 10)
    assert np.isfinite(encoded).all() and np.abs(encoded[:, 3:]).max() <= 1
    assert np.abs(encoded - oracle_encoding(points, 10))[:, 3:].max() < 1e-6


def test_encoding_keeps_the_order_of_the_view_encoding():
    directions = np.random.default_rng(1).normal(size=(5, 3)).astype(np.float32)
    assert np.array_equal(positional_encoding(np, directions, 4), view_encoding(np, directions))
    assert np.array_equal(positional_encoding(np, directions, 0), directions)


def oracle_trunk(layers, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    encoded = oracle_encoding(points, 10)
    x = encoded
    for i, (kernel, bias) in enumerate(layers[:-2]):
        x = np.maximum(x @ np.float64(kernel) + bias, 0)
        if i in (4, 8):
            x = np.hstack([x, encoded])
    density, outputs = layers[-2:]
    return x @ np.float64(density.kernel) + density.bias, x @ np.float64(outputs.kernel) + outputs.bias


@pytest.mark.parametrize(("width", "depth"), [(64, 8), (16, 2), (32, 5), (8, 10)])
def test_trunk_of_any_width_and_depth(width, depth):
    random = np.random.default_rng(2)
    layers = init_trunk(random, width, depth)
    assert tuple(layer.kernel.shape for layer in layers) == layer_shapes(width, depth)
    points = random.uniform(-1, 1, (50, 3)).astype(np.float32)
    density, outputs = trunk(np, layers, points)
    expected = oracle_trunk(layers, points)
    assert density.shape == (50,) and outputs.shape == (50, 7)
    assert np.abs(density - expected[0][:, 0]).max() < 1e-5
    assert np.abs(outputs - expected[1]).max() < 1e-5


def test_numpy_and_jax_agree():
    jnp = pytest.importorskip("jax.numpy")
    random = np.random.default_rng(3)
    layers = init_trunk(random, 32, 8)
    points = random.uniform(-1, 1, (64, 3)).astype(np.float32)
    for ours, theirs in zip(mlp_field(np, layers, points), mlp_field(jnp, layers, points), strict=True):
        assert np.abs(ours - np.asarray(theirs)).max() < 1e-5


def test_outputs_stay_in_range():
    layers = init_trunk(np.random.default_rng(4), 16, 3)
    layers = tuple(layer._replace(bias=layer.bias + 1e3) for layer in layers)
    density, colour, features = mlp_field(np, layers, np.zeros((4, 3), np.float32))
    assert (density >= 0).all() and colour.max() <= 1 and features.min() >= 0


def test_the_same_generator_gives_the_same_bytes():
    first, second = (init_trunk(np.random.default_rng(7), 8, 2) for _ in range(2))
    assert all(a.kernel.tobytes() == b.kernel.tobytes() for a, b in zip(first, second, strict=True))


def test_initial_weights_are_glorots():
    """Uniform between plus and minus sqrt(6 / (in + out)); biases are 0."""
    layers = init_trunk(np.random.default_rng(0), 200, 3)
    for layer in layers:
        reach = np.sqrt(6 / sum(layer.kernel.shape))
        assert 0.95 * reach < layer.kernel.max() <= reach and -reach <= layer.kernel.min() < -0.95 * reach
        assert layer.kernel.dtype == np.float32 and not layer.bias.any()
    wide = layers[1].kernel.ravel()
    share = np.histogram(wide, 10, (-np.sqrt(6 / 400), np.sqrt(6 / 400)))[0] / len(wide)
    assert np.abs(share - 0.1).max() < 0.01
