"""Filling the atlas (section 5.3): in each voxel the average of what the field gives at a few points of it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..nerf.field import Field
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS, counts, fill_aprons, number, pack, places_of, reach, renumbered, unpack
from ..scene.quantize import quantize
from ..scene.voxel_grid import VoxelGrid
from .jitter import voxel_uniform
from .resume import Arrays, ResumeCache, are, each
from .supersampling import average

VOXELS = 2**16  # of a slab, about


def fill(
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
    wanted = number(reach(bits, indirection))
    bits = renumbered(bits, indirection, wanted)
    places = places_of(wanted)
    slabs = cut(counts(bits))

    def work(slab: int) -> Arrays:
        row, *local = np.nonzero(unpack(bits[slabs[slab]]))
        voxels = places[slabs[slab]][row] * DATA_VOXELS + np.stack(local, axis=-1)
        colour, alpha = average(field, voxel_grid, voxels, samples, seed)
        values = np.concatenate([colour[:, : channels - 1], alpha[:, None]], axis=-1)
        return {"values": quantize(values, voxel_uniform(voxels, channels, seed + 1)) if quantised else values}

    cells = np.zeros((len(places), *(CELL_VOXELS,) * 3, channels), np.uint8 if quantised else np.float32)
    sizes, kind = counts(bits), np.uint8 if quantised else np.floating

    def fits(slab: int, arrays: Arrays) -> bool:
        return are(arrays, {"values": ((int(sizes[slabs[slab]].sum()), channels), kind)})

    for slab, arrays in each("prefilter", len(slabs), work, kept, lambda f: tell(0.95 * f), fits):
        rows = slabs[slab]
        mask = unpack(bits[rows])
        cells[rows, 1:-1, 1:-1, 1:-1][mask] = arrays["values"]
        mask[mask] = arrays["values"].any(axis=-1)
        bits[rows] = pack(mask)
    kept_blocks = number(reach(bits, wanted))
    cells = gathered(cells, wanted[kept_blocks >= 0])
    for done in fill_aprons(cells, kept_blocks):
        tell(0.95 + 0.05 * done / len(cells))
    return cells, kept_blocks


def cut(sizes: NDArray[Any]) -> list[slice]:
    """Runs of blocks of about VOXELS voxels each, from how many each block has [M]."""
    group = (np.cumsum(sizes) - 1) // VOXELS
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(sizes)]
    return [slice(first, end) for first, end in pairwise(edges) if end > first]


def gathered(cells: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """Cells of rising numbers `rows`, moved to the front in place: an atlas is too large to copy."""
    for to, row in enumerate(rows.tolist()):
        if to != row:
            cells[to] = cells[row]
    return cells[: len(rows)]
