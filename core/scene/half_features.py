"""Features at half the resolution: one straight value for each 2 x 2 x 2 voxels of a cell.

A feature means nothing where there is no opacity, so that it is stored straight, as the mean weighted by alpha, and multiplied by each
voxel's own alpha again. A cell of 32 voxels begins at an odd voxel of the grid: all cells that hold a voxel, in an apron or not, group it
with the same others, and block borders need no care.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .blocks import BLOCKS_PER_CHUNK, CELL_VOXELS

# Of each 8-bit value the nearest of 64 levels: a fifth fewer bytes of features, and not 0.001 dB.
LEVELS = np.rint(np.rint(np.arange(256) * (63 / 255)) * (255 / 63)).astype(np.uint8)


def halve_features(voxels: NDArray[Any]) -> NDArray[Any]:
    """The features of voxels at half their resolution, straight: uint8 [A / 2, B / 2, C / 2, 4]; 0 where all alpha is 0.

    voxels: uint8 [A, B, C, 8] (RGB, four features premultiplied by alpha, alpha), from a cell's first voxel along each axis on. Values
    are rounded to LEVELS.
    """
    a, b, c = (n // 2 for n in voxels.shape[:3])
    groups = voxels[..., 3:].reshape(a, 2, b, 2, c, 2, 5)
    sums = np.zeros((a, b, c, 5), np.uint32)
    for i, j, k in product((0, 1), repeat=3):
        sums += groups[:, i, :, j, :, k]
    alpha = np.maximum(sums[..., 4:], 1)
    straight = np.minimum((255 * sums[..., :4] + alpha // 2) // alpha, 255)
    levels: NDArray[Any] = LEVELS[straight]
    return levels


def restore_features(straight: NDArray[Any], alpha: NDArray[Any]) -> NDArray[Any]:
    """The features of voxels, premultiplied: uint8 [A, B, C, 4], never above alpha. straight: of `halve_features`; alpha: [A, B, C]."""
    whole = straight.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2).astype(np.uint16)
    features: NDArray[Any] = ((whole * alpha[..., None] + np.uint16(127)) // np.uint16(255)).astype(np.uint8)
    return features


def with_half_features(cells: NDArray[Any]) -> NDArray[Any]:
    """Cells uint8 [M, 32, 32, 32, 8] with features as they are read after they were stored at half the resolution."""
    changed = cells.copy()
    for start in range(0, len(cells), BLOCKS_PER_CHUNK):
        part = changed[start : start + BLOCKS_PER_CHUNK].reshape(-1, CELL_VOXELS, CELL_VOXELS, cells.shape[-1])
        part[..., 3:7] = restore_features(halve_features(part), part[..., 7])
    return changed
