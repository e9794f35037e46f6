"""Aprons, dilation across block borders, and quantising."""

import numpy as np
import pytest

from snerg.core.baking.jitter import voxel_normal, voxel_uniform
from snerg.core.scene.blocks import OWN_BITS, count_voxels, dilate, fill_aprons, number_blocks, pack_mask, touched_blocks, unpack_mask
from snerg.core.scene.quantize import quantize


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


def test_a_mask_is_packed_and_unpacked():
    own = np.random.default_rng(0).random((3, 30, 30, 30)) < 0.3
    bits = pack_mask(own)
    assert bits.shape == (3, 30, 30) and not (bits & ~OWN_BITS).any() and np.array_equal(unpack_mask(bits), own)
    assert count_voxels(bits).tolist() == own.sum(axis=(1, 2, 3)).tolist()


def test_aprons_hold_the_neighbours_voxels(blocks):
    dense, mask = blocks
    cells = np.zeros((int(mask.sum()), 32, 32, 32), np.uint8)
    cells[:, 1:-1, 1:-1, 1:-1] = split(dense, mask)
    assert list(fill_aprons(cells, number_blocks(mask)))[-1] == len(cells)
    padded = np.pad(dense, 1)
    for place, cell in zip(np.argwhere(mask), cells, strict=True):
        assert np.array_equal(cell, padded[tuple(slice(30 * b, 30 * b + 32) for b in place)])


def test_a_mask_grows_across_block_borders(blocks):
    """As a plain dilation of the whole volume does, in whatever blocks there are."""
    mask = blocks[1]
    dense = np.random.default_rng(1).random((90, 60, 90)) < 0.003
    dense &= np.kron(mask, np.ones((30, 30, 30), bool))
    padded = np.pad(dense, 1)
    whole = np.zeros_like(dense)
    for x, y, z in np.ndindex(3, 3, 3):
        whole |= padded[x : x + 90, y : y + 60, z : z + 90]
    grown = dilate(pack_mask(split(dense, mask)), number_blocks(mask))
    assert np.array_equal(unpack_mask(grown), split(whole, mask))


@pytest.mark.hard_case(34)
def test_a_block_without_voxels_keeps_its_neighbours_stencils():
    """A voxel is in the 32^3 of every block that it touches, over faces, edges and corners."""
    mask = np.zeros((3, 3, 3), bool)
    mask[1, 1, 1] = True
    for voxel, expected in (((29, 3, 3), 2), ((29, 0, 3), 4), ((0, 0, 29), 8), ((5, 6, 7), 1)):
        own = np.zeros((1, 30, 30, 30), bool)
        own[(0, *voxel)] = True
        reached = touched_blocks(pack_mask(own), number_blocks(mask))
        assert reached.sum() == expected and reached[1, 1, 1]
        for axis, at in enumerate(voxel):
            side = {0: 0, 29: 2}.get(at, 1)
            assert reached.any(axis=tuple(a for a in range(3) if a != axis))[side]


@pytest.mark.hard_case(45, 46, 54, 57)
def test_empty_blocks_are_dropped():
    assert not touched_blocks(np.zeros((4, 30, 30), np.uint32), number_blocks(np.ones((2, 2, 1), bool))).any()


@pytest.mark.hard_case(51)
@pytest.mark.parametrize("alpha", [0.002, 0.004, 0.02, 0.3, 1.0])
def test_thin_fog_keeps_its_colour(alpha):
    count = 40_000
    values = np.tile(np.float32([0.7 * alpha] * 3 + [alpha]), (count, 1))
    stored = quantize(values, np.random.default_rng(0).random((count, 4), np.float32))
    colour, opacity = stored[:, 0].mean() / 255, stored[:, -1].mean() / 255
    assert opacity == pytest.approx(alpha, rel=0.03)
    assert colour / opacity == pytest.approx(0.7, abs=0.02)
    assert not stored[stored[:, -1] == 0].any()


def test_jitter_is_a_function_of_the_voxel():
    voxels = np.random.default_rng(0).integers(0, 4000, (20_000, 3))
    uniform, normal = voxel_uniform(voxels, 8, 3), voxel_normal(voxels, 2, 3)
    assert np.array_equal(voxel_uniform(voxels[7:9], 8, 3), uniform[7:9])
    assert not np.array_equal(voxel_uniform(voxels, 8, 4), uniform)
    assert uniform.min() >= 0 and uniform.max() < 1
    assert np.abs(uniform.mean(axis=0) - 0.5).max() < 0.01 and np.abs(uniform.var(axis=0) - 1 / 12).max() < 0.003
    assert np.abs(normal.mean(axis=0)).max() < 0.03 and np.abs(normal.std(axis=0) - 1).max() < 0.03
    flat = normal.reshape(-1, 6)
    assert np.abs(np.corrcoef(flat.T) - np.eye(6)).max() < 0.03
