"""Features at half the resolution."""

from itertools import pairwise

import numpy as np
import pytest

from scenes import random_network, snerg_from_volume
from snerg.core.scene.half_features import halve_features, restore_features, with_half_features


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
