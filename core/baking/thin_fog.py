"""How grainy 8 bits a value would make fog: where they are too coarse, a bake stores square roots (see scene/quantize.py)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..nerf.field import Field
from ..nerf.volume_rendering import depth_before, opacity, optical_depth
from ..scene.blocks import DATA_VOXELS, unpack_mask
from ..scene.quantize import DITHER_BELOW
from ..scene.voxel_grid import VoxelGrid

# Levels of 255, of `fog_grain`, above which square roots are stored. Pictures of fog are off by about 0.7 of it, hence by a level. Trained
# fields of objects have 0.3 to 0.6 at 128 to 384 voxels, of their soft surfaces.
MAX_GRAIN = 1.5
ROWS = 64  # rows of voxels along each axis by which it is measured
# Of a voxel's variance, what interpolation between the four rows around a ray leaves: the mean of (1 - x)^2 + x^2, along two axes.
INTERPOLATED = (2 / 3) ** 2


def fog_grain(field: Field, voxel_grid: VoxelGrid, mask: NDArray[Any], indirection: NDArray[Any], seed: int) -> float:
    """Root mean square, in levels of 255, of what dither of even levels changes at most in pixels that look along rows of voxels.

    mask: voxels to bake, uint32 [M, 30, 30]; indirection: int32 [bx, by, bz]. Of random rows along the three axes, those that hold voxels
    count. Of each voxel that `quantize` dithers the transmittance in front of it, squared, times the variance of its dither, f (1 - f) of
    a fraction f of a level, is added up: what a level of its alpha can change in a pixel is at most the light that reaches it.
    """
    if not len(mask):
        return 0.0
    rng = np.random.default_rng(seed)
    along = [rows_along(axis, mask, indirection, rng) for axis in range(3)]
    voxels, rows = np.concatenate([part for part, _ in along]), np.concatenate([part + ROWS * i for i, (_, part) in enumerate(along)])
    depth = optical_depth(np, field.query(voxel_grid.voxel_centres(voxels))[0], np.float32(voxel_grid.voxel_size)).astype(np.float64)
    level = 255 * opacity(np, depth)
    dithered = np.where(level < DITHER_BELOW, level % 1 * (1 - level % 1), 0)
    variance = np.sum(np.exp(-2 * depth_before(np, depth, rows)) * dithered) / max(len(np.unique(rows)), 1)
    return float(np.sqrt(INTERPOLATED * variance))


def rows_along(
    axis: int, mask: NDArray[Any], indirection: NDArray[Any], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The voxels [N, 3] that a mask has on ROWS random rows along an axis, and the number [N] of each one's row, in order along it.

    The rows go through blocks that have a number.
    """
    across = [other for other in range(3) if other != axis]
    lines = np.argwhere((indirection >= 0).any(axis=axis))
    voxels, rows = [], []
    for row in range(ROWS):
        line, inside = lines[rng.integers(len(lines))], rng.integers(DATA_VOXELS, size=2)
        numbers = np.moveaxis(indirection, axis, -1)[tuple(line)]
        blocks = np.flatnonzero(numbers >= 0)
        held = np.moveaxis(unpack_mask(mask[numbers[blocks]]), axis + 1, -1)[:, inside[0], inside[1]]
        block, local = np.nonzero(held)
        found = np.empty((len(block), 3), np.int64)
        found[:, axis] = blocks[block] * DATA_VOXELS + local
        found[:, across] = line * DATA_VOXELS + inside
        voxels.append(found)
        rows.append(np.full(len(block), row))
    return np.concatenate(voxels), np.concatenate(rows)
