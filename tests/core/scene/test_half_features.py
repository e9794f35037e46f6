"""Features at half the resolution."""

from itertools import pairwise

import numpy as np
import pytest

from scenes import random_network, snerg_from_volume
from snerg.core.scene.half_features import LEVELS, halve_features, restore_features, with_half_features


def test_half_features_are_the_mean_weighted_by_alpha():
    voxels = np.zeros((4, 4, 4, 8), np.uint8)
    voxels[1, 0, 0, 3:] = 10, 20, 0, 40, 40
    voxels[0, 1, 1, 3:] = 0, 120, 120, 0, 120
    straight = halve_features(voxels)
    assert straight.shape == (2, 2, 2, 4) and straight[0, 0, 0].tolist() == [
        16,
        223,
        190,
        65,
    ]  # of 255: 10 / 160, 140 / 160, ..., in 64 levels
    assert not straight.reshape(-1, 4)[1:].any()
    restored = restore_features(straight, voxels[..., 7])
    assert restored[1, 0, 0].tolist() == [3, 35, 30, 10] and restored[0, 1, 1].tolist() == [8, 105, 89, 31]
    assert not restored[voxels[..., 7] == 0].any()


@pytest.mark.hard_case(72)
@pytest.mark.parametrize("axis", range(3))
def test_both_sides_of_a_block_border_read_the_same_features(axis):
    """A voxel at a border lies in two cells, in one of them in the apron: both must restore the same value for it."""
    draw = np.random.default_rng(axis)
    shape = np.array([30, 30, 30])
    shape[axis] = 90
    values = draw.integers(0, 256, (*shape, 8)).astype(np.uint8)
    values[..., :7] = np.minimum(values[..., :7], values[..., 7:])
    scene = snerg_from_volume(values, random_network(0), grid_to_world=np.eye(4), voxel_size=1.0)
    cells = np.moveaxis(with_half_features(scene.cells)[..., 3:7], axis + 1, 1)
    order = scene.indirection.reshape(-1)
    for one, other in pairwise(order):
        # The last own voxel and the apron behind it, in the one cell; the apron before and the first own voxel, in the other.
        assert np.array_equal(cells[one, 30:32], cells[other, 0:2])


def test_half_features_are_those_of_float64():
    """Sums past a byte, products past 16 bits, features at and above their alpha, groups without alpha; by rounded halves and 64 levels."""
    draw = np.random.default_rng(0)
    voxels = draw.integers(0, 256, (8, 6, 10, 8)).astype(np.uint8)
    voxels[..., 7] = draw.choice([0, 1, 3, 40, 255], voxels.shape[:3])
    voxels[..., 3:7] = np.minimum(voxels[..., 3:7], voxels[..., 7:])
    voxels[:2] = 255
    voxels[2:4, :2, :2, 3:] = 0
    voxels[4:6, 4:6, 4:6, 3:] = 255, 200, 41, 255, 40  # above its alpha, as other programs store it
    groups = voxels[..., 3:].astype(np.float64).reshape(4, 2, 3, 2, 5, 2, 5).sum(axis=(1, 3, 5))
    with np.errstate(divide="ignore", invalid="ignore"):
        exact = np.where(groups[..., 4:] > 0, 255 * groups[..., :4] / groups[..., 4:], 0).clip(0, 255)
    with np.errstate(all="raise"):
        straight = halve_features(voxels)
    assert np.abs(straight - exact).max() <= 0.5 + 255 / 63 / 2 and np.abs((straight - exact)[exact < 255].mean()) < 0.2
    assert np.array_equal(straight, np.rint(np.floor(np.floor(exact + 0.5) * 63 / 255 + 0.5) * 255 / 63)), "the nearest of 64 levels"
    alpha = voxels[..., 7]
    wide = np.kron(straight, np.ones((2, 2, 2, 1)))
    assert np.array_equal(restore_features(straight, alpha), np.floor(wide * alpha[..., None] / 255 + 127 / 255))


def test_levels_are_64_even_steps():
    steps = np.unique(LEVELS)
    assert len(steps) == 64 and steps[0] == 0 and steps[-1] == 255 and set(np.diff(steps.astype(int))) == {4, 5}
    assert np.abs(LEVELS - np.arange(256)).max() <= 2 and abs((LEVELS - np.arange(256.0)).mean()) < 0.01


@pytest.mark.hard_case(34)
def test_every_cell_is_changed_and_the_given_ones_are_not():
    """More cells than are done at once; a group is the same in each."""
    one = np.zeros((32, 32, 32, 8), np.uint8)
    one[5, 6, 7] = one[4, 6, 7] = 10, 10, 10, 200, 0, 100, 50, 200
    one[4, 6, 7, 3:7] = 0
    cells = np.repeat(one[None], 66, axis=0)
    before = cells.copy()
    changed = with_half_features(cells)
    assert np.array_equal(cells, before) and (changed == changed[:1]).all() and (changed != cells).any(axis=(1, 2, 3, 4)).all()
    assert changed[65, 4, 6, 7].tolist() == changed[65, 5, 6, 7].tolist() == [10, 10, 10, 102, 0, 51, 25, 200] or changed[
        65, 5, 6, 7, 3:7
    ] == pytest.approx([100, 0, 50, 25], abs=3)
