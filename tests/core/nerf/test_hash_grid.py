"""The hash grid: interpolation on tetrahedra, the same in NumPy and JAX."""

import jax.numpy as jnp
import numpy as np
import pytest

from snerg.core.nerf.hash_grid import HashGrid, hash_encode, hash_lookup

SMALL = HashGrid(levels=3, coarsest=4, finest=40, features=2, log2_size=10)


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).random((500, 3)).astype(np.float32)


@pytest.fixture
def tables() -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.normal(size=size * SMALL.features).astype(np.float32) for size in SMALL.sizes]


def test_numpy_and_jax_agree(points, tables):
    here, there = hash_lookup(np, SMALL, points), hash_lookup(jnp, SMALL, jnp.asarray(points))
    assert np.array_equal(here[0], np.asarray(there[0]))
    assert (
        np.abs(hash_encode(np, SMALL, tables, *here) - np.asarray(hash_encode(jnp, SMALL, [jnp.asarray(t) for t in tables], *there))).max()
        < 1e-6
    )


def test_weights_are_those_of_a_tetrahedron(points):
    indices, weights = hash_lookup(np, SMALL, points)
    assert (weights >= -1e-6).all() and np.abs(weights.sum(axis=-1) - 1).max() < 1e-6
    assert indices.min() >= 0 and (indices.max(axis=(1, 2)) < SMALL.sizes).all()


def test_a_linear_function_is_interpolated_exactly(points):
    grid = HashGrid(levels=1, coarsest=8, finest=8, features=1, log2_size=12)
    side = 10
    corner = np.stack(np.unravel_index(np.arange(grid.rows), (side,) * 3), axis=-1)
    table = (corner @ np.float32([1, 2, 3])).astype(np.float32)
    assert np.abs(hash_encode(np, grid, [table], *hash_lookup(np, grid, points))[:, 0] - points @ np.float32([8, 16, 24])).max() < 1e-4


def test_the_faces_of_the_domain_are_inside(points):
    edge = np.float32([[0, 0, 0], [1, 1, 1], [1, 0, 1]])
    indices, weights = hash_lookup(np, SMALL, edge)
    assert (indices.max(axis=(1, 2)) < SMALL.sizes).all() and np.isfinite(weights).all()


def test_it_is_continuous_across_cells(tables):
    line = np.linspace(0.2, 0.8, 20_001, dtype=np.float32)[:, None] * np.float32([1, 0.7, 0.9])
    values = hash_encode(np, SMALL, tables, *hash_lookup(np, SMALL, line))
    assert np.abs(np.diff(values, axis=0)).max() < 0.05
