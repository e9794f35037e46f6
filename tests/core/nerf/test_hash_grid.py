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


def test_resolutions_are_a_geometric_series():
    grid = HashGrid()
    assert grid.resolutions.tolist() == [int(16 * 32 ** (level / 7) + 1e-6) for level in range(8)] and grid.resolutions[-1] == 512
    assert grid.sizes.tolist() == [18**3, 28**3, 45**3, *[2**17] * 5] and grid.rows == 18**3 + 28**3 + 45**3 + 5 * 2**17
    assert HashGrid(levels=1, coarsest=8, finest=8).resolutions.tolist() == [8]
    assert HashGrid(levels=2, coarsest=3, finest=6, log2_size=9).sizes.tolist() == [125, 512]  # 8^3 vertices fit exactly


def golden_vertex(resolution: int, bits: int, x: int, y: int, z: int) -> int:
    """The index of a vertex in its level's table, in integers of any size: Mueller et al. 2022, eq. 4, modulo 2^32 at each product."""
    side = resolution + 2
    if side**3 <= 2**bits:
        return (x * side + y) * side + z
    return (x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % 2**bits


@pytest.mark.parametrize("xnp", [np, jnp], ids=["numpy", "jax"])
def test_indices_and_weights_are_golden(points, xnp):
    """From the cell's lowest corner a step along the axis of the largest fraction, then the middle, then the smallest."""
    grid = HashGrid(levels=4, coarsest=5, finest=700, features=2, log2_size=11)
    corners = np.float32([[0, 0, 0], [1, 1, 1], [0.2, 0.4, 0.6], [0.5, 0.5, 0.25], [0.25, 0.5, 0.5], [0.5, 0.25, 0.5]])
    points = np.concatenate([corners, points[:60]])
    indices, weights = (np.asarray(a) for a in hash_lookup(xnp, grid, xnp.asarray(points)))
    assert indices.dtype == np.int32 and weights.dtype == np.float32
    for level, resolution in enumerate(grid.resolutions.tolist()):
        for point, index, weight in zip(points, indices[level], weights[level], strict=True):
            scaled = (point * np.float32(resolution)).astype(np.float64)
            vertex, fraction = np.floor(scaled).astype(int), scaled - np.floor(scaled)
            axes = sorted(range(3), key=lambda axis: (-fraction[axis], axis))
            steps = [1.0, *(fraction[axis] for axis in axes), 0.0]
            expected = {}
            for step in range(4):
                if steps[step] - steps[step + 1] > 1e-9:
                    expected[golden_vertex(resolution, 11, *vertex.tolist())] = steps[step] - steps[step + 1]
                if step < 3:
                    vertex[axes[step]] += 1
            found: dict[int, float] = {}
            for i, w in zip(index.tolist(), weight.tolist(), strict=True):
                if w > 1e-7:
                    found[i] = found.get(i, 0.0) + w
            assert found.keys() == expected.keys() or sum(abs(found.get(k, 0) - expected.get(k, 0)) for k in {*found, *expected}) < 1e-4
            assert all(abs(found[k] - expected[k]) < 1e-4 for k in found if k in expected)


def test_tables_are_read_at_their_rows():
    grid = HashGrid(levels=2, coarsest=2, finest=2, features=3, log2_size=8)
    tables = [np.arange(64 * 3, dtype=np.float32) + 1000 * level for level in range(2)]
    indices = np.array([[[5, 0, 1, 2]], [[7, 0, 0, 63]]], np.int32)
    weights = np.float32([[[1, 0, 0, 0]], [[0.5, 0, 0, 0.5]]])
    for xnp in (np, jnp):
        got = np.asarray(hash_encode(xnp, grid, [xnp.asarray(t) for t in tables], xnp.asarray(indices), xnp.asarray(weights)))
        assert got.tolist() == [[15, 16, 17, 1105, 1106, 1107]]


def test_a_level_that_just_fits_is_indexed_by_position():
    grid = HashGrid(levels=1, coarsest=6, finest=6, features=1, log2_size=9)  # 8^3 vertices of 2^9
    points = np.random.default_rng(3).random((50, 3)).astype(np.float32)
    indices, _ = hash_lookup(np, grid, points)
    base = np.floor(points * 6).astype(int)
    assert (indices[0, :, 0] == (base[:, 0] * 8 + base[:, 1]) * 8 + base[:, 2]).all()
    grid = HashGrid(levels=1, coarsest=7, finest=7, features=1, log2_size=9)  # 7^3 cells would fit, their 9^3 vertices do not
    base = np.floor(points * np.float32(7)).astype(int).tolist()
    assert hash_lookup(np, grid, points)[0][0, :, 0].tolist() == [golden_vertex(7, 9, *vertex) for vertex in base]


@pytest.mark.parametrize("xnp", [np, jnp], ids=["numpy", "jax"])
def test_a_tie_steps_along_the_earlier_axis_first(xnp):
    """Fractions that are equal, in all ways: four different vertices, of which the last is the cell's far corner."""
    grid = HashGrid(levels=1, coarsest=4, finest=4, features=1, log2_size=12)
    points = np.float32([[x, y, z] for x in (1, 2, 3) for y in (1, 2, 3) for z in (1, 2, 3)]) / 16 + 0.25  # fractions of 1/4 to 3/4
    indices = np.asarray(hash_lookup(xnp, grid, xnp.asarray(points))[0])[0]
    corners = np.stack(np.unravel_index(indices, (6, 6, 6)), axis=-1) - 1
    for point, path in zip(points, corners, strict=True):
        order = sorted(range(3), key=lambda axis: (-point[axis], axis))
        assert path.tolist() == [[int(order.index(axis) < step) for axis in range(3)] for step in range(4)]
