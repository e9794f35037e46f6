"""Last pass of a bake: fills the atlas with the supersampled field (section 5.3)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..nerf.field import Field
from ..scene.blocks import (
    CELL_VOXELS,
    DATA_VOXELS,
    block_coordinates,
    count_voxels,
    fill_aprons,
    number_blocks,
    pack_mask,
    reindex_blocks,
    touched_blocks,
    unpack_mask,
)
from ..scene.voxel_grid import VoxelGrid
from .jitter import voxel_uniform
from .resume import Arrays, ResumeCache, arrays_match, run_parts
from .supersampling import average_in_voxels

Quantiser = Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]
"""`quantize` or `quantize_roots` of scene/quantize.py."""
VOXELS_PER_CHUNK = 2**16  # voxels evaluated together, about: a part of the work that is kept on resume
APRONS = 0.05  # share of the progress that filling the aprons gets


def fill_atlas(
    field: Field,
    voxel_grid: VoxelGrid,
    mask: NDArray[Any],
    indirection: NDArray[Any],
    channels: int,
    supersampling: int,
    seed: int,
    quantiser: Quantiser | None,
    cache: ResumeCache,
    tell: Callable[[float], None],
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Bake the voxels of a mask uint32 [M, 30, 30] of the blocks of `indirection`, int32 [bx, by, bz].

    channels: C, 8 or 4 (see Scene.cells). supersampling: points averaged in a voxel. quantiser: makes uint8 of the values; float32 without.
    tell: called with the fraction done.

    Returns the cells [K, 32, 32, 32, C] and their own indirection grid. Blocks whose 32^3 voxels are all 0 get no cell.
    """
    touched = number_blocks(touched_blocks(mask, indirection))
    mask = reindex_blocks(mask, indirection, touched)
    coordinates, chunks, sizes = block_coordinates(touched), chunk_blocks(count_voxels(mask)), count_voxels(mask)
    kind: Any = np.uint8 if quantiser else np.floating

    def work(part: int) -> Arrays:
        row, *local = np.nonzero(unpack_mask(mask[chunks[part]]))
        voxels = coordinates[chunks[part]][row] * DATA_VOXELS + np.stack(local, axis=-1)
        return {"values": voxel_values(field, voxel_grid, voxels, channels, supersampling, seed, quantiser)}

    def is_valid(part: int, arrays: Arrays) -> bool:
        return arrays_match(arrays, {"values": ((int(sizes[chunks[part]].sum()), channels), kind)})

    cells = np.zeros((len(coordinates), *(CELL_VOXELS,) * 3, channels), np.uint8 if quantiser else np.float32)
    for part, arrays in run_parts("prefilter", len(chunks), work, cache, lambda f: tell((1 - APRONS) * f), is_valid):
        mask[chunks[part]] = _store(cells[chunks[part]], mask[chunks[part]], arrays["values"])
    kept = number_blocks(touched_blocks(mask, touched))
    cells = compact_cells(cells, touched[kept >= 0])
    for done in fill_aprons(cells, kept):
        tell(1 - APRONS + APRONS * done / len(cells))
    return cells, kept


def voxel_values(
    field: Field, voxel_grid: VoxelGrid, voxels: NDArray[Any], channels: int, supersampling: int, seed: int, quantiser: Quantiser | None
) -> NDArray[Any]:
    """Values [N, C] of voxels with indices [N, 3], as cells store them."""
    colour, alpha = average_in_voxels(field, voxel_grid, voxels, supersampling, seed)
    values = np.concatenate([colour[:, : channels - 1], alpha[:, None]], axis=-1)
    return quantiser(values, voxel_uniform(voxels, channels, seed + 1)) if quantiser else values


def _store(cells: NDArray[Any], mask: NDArray[Any], values: NDArray[Any]) -> NDArray[Any]:
    """Write values [N, C] of the voxels of a mask [B, 30, 30] to its cells, in place; returns the mask of those that are not 0."""
    voxels = unpack_mask(mask)
    cells[:, 1:-1, 1:-1, 1:-1][voxels] = values
    voxels[voxels] = values.any(axis=-1)
    return pack_mask(voxels)


def chunk_blocks(sizes: NDArray[Any]) -> list[slice]:
    """Ranges of consecutive blocks with about VOXELS_PER_CHUNK voxels each. sizes: voxels of each block, [M]."""
    group = (np.cumsum(sizes) - 1) // VOXELS_PER_CHUNK
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(sizes)]
    return [slice(first, end) for first, end in pairwise(edges) if end > first]


def compact_cells(cells: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """Move the cells `rows` [K] (ascending indices) to the front of `cells` [M, ...], in place, and return a view of them [K, ...].

    In place because an atlas may be too large to copy; the other cells are overwritten.
    """
    for to, row in enumerate(rows.tolist()):
        if to != row:
            cells[to] = cells[row]
    return cells[: len(rows)]
