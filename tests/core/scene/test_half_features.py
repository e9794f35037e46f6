"""Features at half the resolution."""

import numpy as np

from snerg.core.scene.half_features import halve_features, restore_features


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
