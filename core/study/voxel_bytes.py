"""Bytes of a voxel in files, measured by a few blocks that are baked and compressed at the voxel size in question (JAX)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..baking.bake import BakeSettings, channels_of
from ..baking.occupied_voxels import block_optical_depth, cull_faint
from ..baking.prefilter import Quantiser, voxel_values
from ..export.atlas import atlas_blocks, atlas_slices
from ..export.codecs import PNG, images_of_slice
from ..io.images import png_bytes
from ..nerf.field import Field
from ..scene.blocks import DATA_VOXELS, count_voxels, dilate, number_blocks, unpack_mask
from ..scene.voxel_grid import VoxelGrid

BLOCKS = 32  # that are baked: of two fields at 512 voxels, these took 0.99 and 1.05 times the bytes of all
SETTINGS = BakeSettings()


def kept_voxel_bytes(field: Field, grid: VoxelGrid, blocks: NDArray[np.int64], quantiser: Quantiser, faint: bool = False) -> float:
    """Bytes as PNG of a voxel that a bake of `grid` keeps, its share of the aprons included.

    blocks: coordinates [B, 3] of different blocks that hold something, in ascending order; BLOCKS of them are baked. quantiser: as the
    bake's. faint: whether the bake keeps the faint voxels of thin fog (see find_occupied_voxels). Voxels of a block that no camera sees
    are counted and stored like the others. Where the blocks hold nothing: those in memory.
    """
    chosen = np.random.default_rng(0).choice(len(blocks), min(len(blocks), BLOCKS), replace=False)  # evenly would follow the lattice
    some = blocks[np.sort(chosen)]
    channels, threshold = channels_of(field, SETTINGS), -float(np.log1p(-SETTINGS.alpha_threshold))
    threshold /= max(grid.blocks) if faint else 1
    culled = cull_faint(block_optical_depth(field, grid, some), threshold) if len(some) else {"full": np.zeros(0, bool)}
    if not culled["full"].any():
        return float(channels)
    some, flags = some[culled["full"]], np.zeros(grid.blocks, bool)
    flags[tuple(some.T)] = True
    mask = dilate(culled["bits"], number_blocks(flags))
    kept = unpack_mask(mask)
    row, *local = np.nonzero(kept)
    cells = np.zeros((*kept.shape, channels), np.uint8)
    cells[kept] = voxel_values(field, grid, some[row] * DATA_VOXELS + np.stack(local, axis=-1), channels, 1, SETTINGS.seed, quantiser)
    # The neighbours, whose voxels an apron repeats, are not baked: the block's own voxels, mirrored, compress alike.
    cells = np.pad(cells, ((0, 0), (1, 1), (1, 1), (1, 1), (0, 0)), mode="reflect")
    images = (image for part in atlas_slices(cells, atlas_blocks(len(cells))) for image in images_of_slice(part, PNG).values())
    return sum(len(png_bytes(image)) for image in images) / int(count_voxels(mask).sum())
