"""Aprons, dilation across block borders, and quantising."""

import numpy as np
import pytest

from snerg.core.grid.blocks import cells_of, dilate, number, with_apron
from snerg.core.grid.jitter import voxel_normal, voxel_uniform
from snerg.core.grid.quantize import quantize


def split(dense: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[30 bx, 30 by, 30 bz] to the blocks of `mask`, [M, 30, 30, 30]."""
    return np.stack([dense[tuple(slice(30 * b, 30 * b + 30) for b in place)] for place in np.argwhere(mask)])


@pytest.fixture
def blocks() -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(0)
    mask = draw.random((3, 2, 3)) < 0.7
    dense = draw.integers(0, 255, (90, 60, 90), dtype=np.uint8)
    dense[~np.kron(mask, np.ones((30, 30, 30), bool))] = 0
    return dense, mask


def test_aprons_hold_the_neighbours_voxels(blocks):
    dense, mask = blocks
    cells = with_apron(split(dense, mask), number(mask))
    padded = np.pad(dense, 1)
    for place, cell in zip(np.argwhere(mask), cells, strict=True):
        assert np.array_equal(cell, padded[tuple(slice(30 * b, 30 * b + 32) for b in place)])


def test_dilation_crosses_block_borders():
    mask = np.ones((2, 1, 1), bool)
    dense = np.zeros((60, 30, 30), bool)
    dense[29, 15, 15] = True
    grown = dilate(split(dense, mask), number(mask), 2)
    assert grown[0, 27:, 13:18, 13:18].all() and grown[1, :2, 13:18, 13:18].all()
    assert grown.sum() == 125


@pytest.mark.hard_case(34)
def test_a_block_without_voxels_keeps_its_neighbours_tent():
    mask = np.array([True, False, False]).reshape(3, 1, 1)
    own = np.zeros((1, 30, 30, 30, 4), np.uint8)
    own[0, 29, 3, 3] = 200
    cells, kept = cells_of(own, number(mask))
    assert (kept.ravel() >= 0).tolist() == [True, True, False]
    assert cells[1, 0, 4, 4, 3] == 200


@pytest.mark.hard_case(45, 46, 54, 57)
def test_empty_blocks_are_dropped_and_none_is_left_out():
    cells, kept = cells_of(np.zeros((4, 30, 30, 30, 8), np.uint8), number(np.ones((2, 2, 1), bool)))
    assert cells.shape == (0, 32, 32, 32, 8) and (kept == -1).all()


@pytest.mark.hard_case(51)
@pytest.mark.parametrize("alpha", [0.002, 0.004, 0.02, 0.3, 1.0])
def test_thin_fog_keeps_its_colour(alpha):
    count = 40_000
    stored = quantize(
        np.full((count, 3), 0.7 * alpha, np.float32),
        np.full(count, alpha, np.float32),
        np.random.default_rng(0).random((count, 4), np.float32),
    )
    colour, opacity = stored[:, 0].mean() / 255, stored[:, -1].mean() / 255
    assert opacity == pytest.approx(alpha, rel=0.03)
    assert colour / opacity == pytest.approx(0.7, abs=0.02)
    assert not stored[stored[:, -1] == 0].any()


def test_jitter_belongs_to_the_voxel():
    voxels = np.random.default_rng(0).integers(0, 4000, (20_000, 3))
    uniform, normal = voxel_uniform(voxels, 8, 3), voxel_normal(voxels, 2, 3)
    assert np.array_equal(voxel_uniform(voxels[7:9], 8, 3), uniform[7:9])
    assert not np.array_equal(voxel_uniform(voxels, 8, 4), uniform)
    assert uniform.min() >= 0 and uniform.max() < 1
    assert np.abs(uniform.mean(axis=0) - 0.5).max() < 0.01 and np.abs(uniform.var(axis=0) - 1 / 12).max() < 0.003
    assert np.abs(normal.mean(axis=0)).max() < 0.03 and np.abs(normal.std(axis=0) - 1).max() < 0.03
    flat = normal.reshape(-1, 6)
    assert np.abs(np.corrcoef(flat.T) - np.eye(6)).max() < 0.03
