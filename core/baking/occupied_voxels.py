"""First pass of a bake: the voxels that a field occupies, at full resolution (hard case 44), a few blocks at a time."""

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

BLOCKS_PER_CHUNK = 8  # blocks evaluated together: a part of the work that is kept on resume
# Optical depth of a voxel's length up to which the voxel is faint, and dropped unless many faint ones add up along a row.
FAINT_DEPTH = np.float32(1 / 1024)
ZERO_DEPTH = np.float32(1e-6)  # optical depth up to which a voxel is empty even in fog
# Opacity, lost along a whole row of the grid, from which blocks that are faint on their own are kept: fog. What a trained field loses
# is haze outside of objects, and less (Lego: 0.037).
MAX_LOST = 0.05
CELL_MARGIN = 1e-3  # voxels by which an occupancy cell is enlarged before its blocks are found: more than rounding


@dataclass(frozen=True, eq=False)
class OccupiedVoxels:
    """The voxels of a grid that a field occupies."""

    indirection: NDArray[Any]  # int32 [bx, by, bz], number of each occupied block, or -1
    mask: NDArray[Any]  # uint32 [M, 30, 30], occupied voxels (see scene/blocks.py)
    coarse_opacity: NDArray[Any]  # uint8 [M, 15, 15, 15], opacity * 255 along the length of two voxels, rounded up; of 2^3 voxels
    opacity_lost: float  # largest opacity that a ray along an axis can lose to dropped voxels


def find_occupied_voxels(
    field: Field, voxel_grid: VoxelGrid, threshold: float, cache: ResumeCache, tell: Callable[[float], None]
) -> OccupiedVoxels:
    """Evaluate a field's density at the centres of the voxels and find the occupied ones.

    threshold: opacity that must add up along some row of 30 voxels for a block, or its faint voxels, to be kept. A threshold for each voxel
    alone would depend on the voxel's size: a hundred voxels of opacity just under 0.005 are 39 % opaque (hard case 52).
    Where more than MAX_LOST is lost along a row of the whole grid, thin fog that fills many blocks, the threshold holds for that row:
    each of its blocks may lose its share.
    tell: called with the fraction done.
    """
    threshold_depth = -float(np.log1p(-threshold))
    found = _find(field, voxel_grid, threshold_depth, "occupancy", cache, tell)
    if found.opacity_lost <= MAX_LOST:
        return found
    return _find(field, voxel_grid, threshold_depth / max(voxel_grid.blocks), "fog", cache, tell)


def _find(
    field: Field, voxel_grid: VoxelGrid, threshold_depth: float, stage: str, cache: ResumeCache, tell: Callable[[float], None]
) -> OccupiedVoxels:
    """`find_occupied_voxels` with the optical depth that must add up along a row of a block. stage: the name of the work in the cache."""
    candidates = np.argwhere(candidate_blocks(field, voxel_grid))

    def chunk(part: int) -> NDArray[Any]:
        return candidates[part * BLOCKS_PER_CHUNK : (part + 1) * BLOCKS_PER_CHUNK]

    def work(part: int) -> Arrays:
        return cull_faint(block_optical_depth(field, voxel_grid, chunk(part)), threshold_depth)

    def is_valid(part: int, arrays: Arrays) -> bool:
        return _is_culled_chunk(arrays, len(chunk(part)))

    found = dict(run_parts(stage, -(-len(candidates) // BLOCKS_PER_CHUNK), work, cache, tell, is_valid))
    full = _concatenate(found, "full", np.zeros(0, bool))
    occupied = np.zeros(voxel_grid.blocks, bool)
    occupied[tuple(candidates[full].T)] = True
    lost = np.zeros((*voxel_grid.blocks, 3), np.float32)
    lost[tuple(candidates.T)] = _concatenate(found, "lost", np.zeros((0, 3), np.float32))
    depth_lost = max(float(lost[..., axis].sum(axis=axis).max(initial=0)) for axis in range(3))
    mask = _concatenate(found, "bits", np.zeros((0, DATA_VOXELS, DATA_VOXELS), np.uint32))
    coarse = _concatenate(found, "coarse", np.zeros((0, *(DATA_VOXELS // 2,) * 3), np.uint8))
    return OccupiedVoxels(number_blocks(occupied), mask, coarse, -float(np.expm1(-depth_lost)))


def _is_culled_chunk(arrays: Arrays, blocks: int) -> bool:
    """Whether kept arrays can be `cull_faint` of so many blocks."""
    full = int(arrays["full"].sum()) if "full" in arrays and arrays["full"].dtype == bool else 0
    side, half = DATA_VOXELS, DATA_VOXELS // 2
    masks = {"bits": ((full, side, side), np.uint32), "coarse": ((full, half, half, half), np.uint8)}
    return arrays_match(arrays, {"full": ((blocks,), np.bool_), "lost": ((blocks, 3), np.floating), **masks})


def _concatenate(found: dict[int, Arrays], name: str, empty: NDArray[Any]) -> NDArray[Any]:
    """The arrays of a name of all parts, in order."""
    return np.concatenate([empty, *(found[part][name] for part in sorted(found))])


def candidate_blocks(field: Field, voxel_grid: VoxelGrid) -> NDArray[Any]:
    """bool [bx, by, bz]: blocks that intersect an occupied cell of the field's own occupancy grid; all blocks if the field has none."""
    if field.occupancy is None:
        return np.ones(voxel_grid.blocks, bool)
    cells = round(len(field.occupancy) ** (1 / 3))
    cell = np.stack(np.unravel_index(np.flatnonzero(field.occupancy), (cells,) * 3), axis=-1)
    centres = field.domain.to_world((cell + 0.5) * (2 / cells) - 1)
    rotation, voxel = voxel_grid.grid_to_world[:3, :3], voxel_grid.voxel_size
    middle = (centres - voxel_grid.grid_to_world[:3, 3]) @ rotation / voxel
    half_extent = np.abs(rotation).sum(axis=0) / (cells * field.domain.scale * voxel) + CELL_MARGIN
    first, last = (np.floor((middle + sign * half_extent) / DATA_VOXELS).astype(np.int64) for sign in (-1, 1))
    return blocks_in_ranges(first, last, voxel_grid.blocks)


def block_optical_depth(field: Field, voxel_grid: VoxelGrid, coordinates: NDArray[Any]) -> NDArray[Any]:
    """Optical depth float32 [B, 30, 30, 30] of one voxel's length, density * voxel_size, at the voxel centres of blocks [B, 3].

    It is 0 where the field's occupancy grid is empty and past the grid's last voxel.
    """
    depth = np.zeros((len(coordinates), DATA_VOXELS**3), np.float32)
    held, points = [], []
    for block in coordinates:  # one by one: a block's points fit the processor's caches
        centres = voxel_grid.block_centres(block[None])
        held.append(np.flatnonzero(field.holds(field.domain.from_world(centres))))
        points.append(centres[held[-1]])
    all_points = np.concatenate(points)
    found = optical_depth(np, field.query(all_points)[0], np.float32(voxel_grid.voxel_size)) if len(all_points) else np.zeros(0)
    ends = np.cumsum([len(rows) for rows in held])
    for row, end in enumerate(ends):
        depth[row, held[row]] = found[end - len(held[row]) : end]
    blocks = depth.reshape(-1, *(DATA_VOXELS,) * 3)
    voxel_grid.zero_outside(blocks, coordinates)
    return blocks


def cull_faint(depth: NDArray[Any], threshold_depth: float) -> Arrays:
    """Decide which blocks and voxels are kept, by their optical depth [B, 30, 30, 30] of a voxel's length.

    threshold_depth: optical depth that must add up along a row of a block. Faint voxels (up to FAINT_DEPTH) are kept only in blocks where
    they alone add up to it along a row: fog.

    Returns "full", bool [B]: blocks that are kept; of those K, "bits" uint32 [K, 30, 30] and "coarse" uint8 [K, 15, 15, 15] (`mask` and
    `coarse_opacity` of OccupiedVoxels); and "lost", float32 [B, 3]: the most optical depth that was dropped along a row, along each axis.
    """
    thick = depth > FAINT_DEPTH
    all_along, faint_along = max_row_depth(depth), max_row_depth(np.where(thick, 0, depth))
    full, fog = all_along.max(axis=-1) >= threshold_depth, faint_along.max(axis=-1) >= threshold_depth
    mask = thick | (fog[:, None, None, None] & (depth > ZERO_DEPTH))
    lost = np.where(full[:, None], np.where(fog[:, None], 0, faint_along), all_along)
    return {"full": full, "lost": lost, "bits": pack_mask(mask[full]), "coarse": coarse_opacity(np.where(mask, depth, 0)[full])}


def max_row_depth(depth: NDArray[Any]) -> NDArray[Any]:
    """The largest sum along a row of voxels, for each axis, [B, 3], of blocks [B, 30, 30, 30]."""
    return np.stack([depth.sum(axis=axis).max(axis=(1, 2)) for axis in (1, 2, 3)], axis=-1)


def coarse_opacity(depth: NDArray[Any]) -> NDArray[Any]:
    """OccupiedVoxels.coarse_opacity, uint8 [B, 15, 15, 15], of optical depths [B, 30, 30, 30] of a voxel's length.

    The transmittance of the eight voxels is averaged, and squared for a path of two voxels.
    """
    transmittance = np.exp(-depth)
    for axis in (1, 2, 3):
        even, odd = ((slice(None),) * axis + (slice(start, None, 2),) for start in (0, 1))
        transmittance = (transmittance[even] + transmittance[odd]) / 2
    level: NDArray[Any] = np.ceil((1 - np.square(transmittance)) * 255 - 1e-3)
    return level.clip(0, 255).astype(np.uint8)
