"""Which voxels of a lattice a field fills: the first pass of a bake, at full resolution (hard case 44), a slab at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..nerf.field import Field
from ..nerf.volume_rendering import optical_depth
from ..scene.blocks import DATA_VOXELS, blocks_in_ranges, number_blocks, pack_mask
from ..scene.voxel_grid import VoxelGrid
from .resume import Arrays, ResumeCache, arrays_match, run_parts

BLOCKS_PER_CHUNK = 8  # blocks looked at together
FAINT_DEPTH = np.float32(1 / 1024)  # optical depth of a voxel up to which it is left out, unless many add up
ZERO_DEPTH = np.float32(1e-6)


@dataclass(frozen=True, eq=False)
class OccupiedVoxels:
    """What a field holds on a lattice.

    indirection: int32 [bx, by, bz], number of a block or -1. bits: uint32 [M, 30, 30], voxels that hold something (see blocks.py).
    coarse: uint8 [M, 15, 15, 15], opacity of 255 over the length of two voxels, rounded up; a voxel of two on a side.
    lost: the opacity that a ray along an axis may lose at most to what is left out.
    """

    indirection: NDArray[Any]
    bits: NDArray[Any]
    coarse: NDArray[Any]
    lost: float


def find_occupied_voxels(
    field: Field, voxel_grid: VoxelGrid, threshold: float, kept: ResumeCache, tell: Callable[[float], None]
) -> OccupiedVoxels:
    """Look for what a field holds at the centres of a lattice's voxels.

    threshold: opacity that must add up along some row of a block's 30 voxels for the block, or for its faint voxels, to be kept.
    A threshold on each voxel would depend on their size: a hundred voxels just under 0.005 are 39% opaque (hard case 52).
    """
    candidates = np.argwhere(candidate_blocks(field, voxel_grid))

    def look(slab: int) -> Arrays:
        places = candidates[slab * BLOCKS_PER_CHUNK : (slab + 1) * BLOCKS_PER_CHUNK]
        return cull_faint(block_optical_depth(field, voxel_grid, places), -np.log1p(-threshold))

    def fits(slab: int, arrays: Arrays) -> bool:
        size = len(candidates[slab * BLOCKS_PER_CHUNK : (slab + 1) * BLOCKS_PER_CHUNK])
        full = int(arrays["full"].sum()) if "full" in arrays and arrays["full"].dtype == bool else 0
        side, half = DATA_VOXELS, DATA_VOXELS // 2
        masks = {"bits": ((full, side, side), np.uint32), "coarse": ((full, half, half, half), np.uint8)}
        return arrays_match(arrays, {"full": ((size,), np.bool_), "lost": ((size, 3), np.floating), **masks})

    found = dict(run_parts("occupancy", -(-len(candidates) // BLOCKS_PER_CHUNK), look, kept, tell, fits))
    full = _concatenate(found, "full", np.zeros(0, bool))
    mask = np.zeros(voxel_grid.blocks, bool)
    mask[tuple(candidates[full].T)] = True
    lost = np.zeros((*voxel_grid.blocks, 3), np.float32)
    lost[tuple(candidates.T)] = _concatenate(found, "lost", np.zeros((0, 3), np.float32))
    along = max(float(lost[..., axis].sum(axis=axis).max(initial=0)) for axis in range(3))
    bits = _concatenate(found, "bits", np.zeros((0, DATA_VOXELS, DATA_VOXELS), np.uint32))
    coarse = _concatenate(found, "coarse", np.zeros((0, *(DATA_VOXELS // 2,) * 3), np.uint8))
    return OccupiedVoxels(number_blocks(mask), bits, coarse, -float(np.expm1(-along)))


def _concatenate(found: dict[int, Arrays], name: str, empty: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([empty, *(found[slab][name] for slab in sorted(found))])


def candidate_blocks(field: Field, voxel_grid: VoxelGrid) -> NDArray[Any]:
    """bool [bx, by, bz]: blocks that meet an occupied cell of the field's own grid, or all where it has none."""
    if field.occupancy is None:
        return np.ones(voxel_grid.blocks, bool)
    cells = round(len(field.occupancy) ** (1 / 3))
    cell = np.stack(np.unravel_index(np.flatnonzero(field.occupancy), (cells,) * 3), axis=-1)
    centres = field.domain.to_world((cell + 0.5) * (2 / cells) - 1)
    rotation, voxel = voxel_grid.grid_to_world[:3, :3], voxel_grid.voxel_size
    middle = (centres - voxel_grid.grid_to_world[:3, 3]) @ rotation / voxel
    half = np.abs(rotation).sum(axis=0) / (cells * field.domain.scale * voxel) + 1e-3
    first, last = (np.floor((middle + way * half) / DATA_VOXELS).astype(np.int64) for way in (-1, 1))
    return blocks_in_ranges(first, last, voxel_grid.blocks)


def block_optical_depth(field: Field, voxel_grid: VoxelGrid, places: NDArray[Any]) -> NDArray[Any]:
    """Optical depth float32 [B, 30, 30, 30] of one voxel's length at the voxels' centres of blocks at places [B, 3]."""
    depth = np.zeros((len(places), DATA_VOXELS**3), np.float32)
    held, points = [], []
    for place in places:  # a block's points fit the caches
        centres = voxel_grid.block_centres(place[None])
        held.append(np.flatnonzero(field.holds(field.domain.from_world(centres))))
        points.append(centres[held[-1]])
    together = np.concatenate(points)
    found = optical_depth(np, field.query(together)[0], np.float32(voxel_grid.voxel_size)) if len(together) else np.zeros(0)
    ends = np.cumsum([len(some) for some in held])
    for row, end in enumerate(ends):
        depth[row, held[row]] = found[end - len(held[row]) : end]
    blocks = depth.reshape(-1, *(DATA_VOXELS,) * 3)
    voxel_grid.zero_outside(blocks, places)
    return blocks


def cull_faint(depth: NDArray[Any], least: float) -> Arrays:
    """What is kept of blocks [B, 30, 30, 30] by optical depth, where `least` must add up along a row of one.

    "full" bool [B]: which are; of those "bits" and "coarse" (see OccupiedVoxels). "lost" [B, 3]: depth left out of all of them, at most,
    along each axis.
    """
    thick = depth > FAINT_DEPTH
    whole, faint = max_row_depth(depth), max_row_depth(np.where(thick, 0, depth))
    full, fog = whole.max(axis=-1) >= least, faint.max(axis=-1) >= least
    mask = thick | (fog[:, None, None, None] & (depth > ZERO_DEPTH))
    lost = np.where(full[:, None], np.where(fog[:, None], 0, faint), whole)
    return {"full": full, "lost": lost, "bits": pack_mask(mask[full]), "coarse": coarse_opacity(np.where(mask, depth, 0)[full])}


def max_row_depth(depth: NDArray[Any]) -> NDArray[Any]:
    """The largest sum along a row of voxels in each direction, [B, 3], of blocks [B, 30, 30, 30]."""
    return np.stack([depth.sum(axis=axis).max(axis=(1, 2)) for axis in (1, 2, 3)], axis=-1)


def coarse_opacity(depth: NDArray[Any]) -> NDArray[Any]:
    """Optical depth [B, 30, 30, 30] of a voxel's length to `OccupiedVoxels.coarse`: never more than light would be stopped on average."""
    through = np.exp(-depth)
    for axis in (1, 2, 3):
        even, odd = ((slice(None),) * axis + (slice(start, None, 2),) for start in (0, 1))
        through = (through[even] + through[odd]) / 2
    return np.ceil((1 - through**2) * 255 - 1e-3).clip(0, 255).astype(np.uint8)
