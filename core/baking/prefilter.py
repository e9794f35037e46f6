"""Filling the atlas (section 5.3): in each voxel the average of what the field gives at a few points of it."""

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
from ..scene.quantize import quantize
from ..scene.voxel_grid import VoxelGrid
from .jitter import voxel_uniform
from .resume import Arrays, ResumeCache, arrays_match, run_parts
from .supersampling import average_in_voxels

VOXELS_PER_CHUNK = 2**16  # of a slab, about


def fill_atlas(
    field: Field,
    voxel_grid: VoxelGrid,
    bits: NDArray[Any],
    indirection: NDArray[Any],
    channels: int,
    samples: int,
    seed: int,
    quantised: bool,
    kept: ResumeCache,
    tell: Callable[[float], None],
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Bake the voxels of a mask [M, 30, 30] into cells [R, 32, 32, 32, C] and their own indirection grid.

    channels: C. quantised: uint8, else float32. A cell is kept when anything in its 32^3 is not 0; one with nothing is dropped.
    """
    wanted = number_blocks(touched_blocks(bits, indirection))
    bits = reindex_blocks(bits, indirection, wanted)
    places = block_coordinates(wanted)
    slabs = chunk_blocks(count_voxels(bits))

    def work(slab: int) -> Arrays:
        row, *local = np.nonzero(unpack_mask(bits[slabs[slab]]))
        voxels = places[slabs[slab]][row] * DATA_VOXELS + np.stack(local, axis=-1)
        colour, alpha = average_in_voxels(field, voxel_grid, voxels, samples, seed)
        values = np.concatenate([colour[:, : channels - 1], alpha[:, None]], axis=-1)
        return {"values": quantize(values, voxel_uniform(voxels, channels, seed + 1)) if quantised else values}

    cells = np.zeros((len(places), *(CELL_VOXELS,) * 3, channels), np.uint8 if quantised else np.float32)
    sizes, kind = count_voxels(bits), np.uint8 if quantised else np.floating

    def fits(slab: int, arrays: Arrays) -> bool:
        return arrays_match(arrays, {"values": ((int(sizes[slabs[slab]].sum()), channels), kind)})

    for slab, arrays in run_parts("prefilter", len(slabs), work, kept, lambda f: tell(0.95 * f), fits):
        rows = slabs[slab]
        mask = unpack_mask(bits[rows])
        cells[rows, 1:-1, 1:-1, 1:-1][mask] = arrays["values"]
        mask[mask] = arrays["values"].any(axis=-1)
        bits[rows] = pack_mask(mask)
    kept_blocks = number_blocks(touched_blocks(bits, wanted))
    cells = compact_cells(cells, wanted[kept_blocks >= 0])
    for done in fill_aprons(cells, kept_blocks):
        tell(0.95 + 0.05 * done / len(cells))
    return cells, kept_blocks


def chunk_blocks(sizes: NDArray[Any]) -> list[slice]:
    """Runs of blocks of about VOXELS voxels each, from how many each block has [M]."""
    group = (np.cumsum(sizes) - 1) // VOXELS_PER_CHUNK
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(sizes)]
    return [slice(first, end) for first, end in pairwise(edges) if end > first]


def compact_cells(cells: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """Cells of rising numbers `rows`, moved to the front in place: an atlas is too large to copy."""
    for to, row in enumerate(rows.tolist()):
        if to != row:
            cells[to] = cells[row]
    return cells[: len(rows)]
