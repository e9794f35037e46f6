"""Macroblocks of 30^3 voxels: indirection grids, bit masks of voxels, and operations that cross block borders.

A block has integer coordinates (bx, by, bz), and a number if an indirection grid has given it one. "Mask" in this file means a bit mask of
the voxels of M numbered blocks: uint32 [M, 30, 30], voxel z in bit z + 1; bits 0 and 31 are free for the apron. A mask takes an eighth of
the memory of bools, and dilating it takes a few shifts.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

DATA_VOXELS = 30  # a macroblock's own voxels along an axis
CELL_VOXELS = 32  # with an apron of one voxel on each side, as stored in the atlas (section 5.1)
NEIGHBOUR_OFFSETS = tuple(offset for offset in product((-1, 0, 1), repeat=3) if any(offset))
OWN_BITS = np.uint32(0x7FFFFFFE)  # bits of the block's own voxels
FIRST_BIT, LAST_BIT = np.uint32(1 << 1), np.uint32(1 << DATA_VOXELS)  # of voxels z = 0 and z = 29
BLOCKS_PER_CHUNK = 64  # blocks processed at once in loops over all: bounds the temporary arrays
_POPCOUNT = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1)


def pack_mask(voxels: NDArray[Any]) -> NDArray[Any]:
    """bool [M, 30, 30, 30] to a mask uint32 [M, 30, 30]."""
    wide = np.pad(voxels, ((0, 0), (0, 0), (0, 0), (1, 1)))
    return np.packbits(wide, axis=-1, bitorder="little").view("<u4")[..., 0].astype(np.uint32)


def unpack_mask(mask: NDArray[Any]) -> NDArray[Any]:
    """A mask uint32 [M, 30, 30] to bool [M, 30, 30, 30]."""
    bytes_ = np.ascontiguousarray(mask).astype("<u4")[..., None].view(np.uint8)
    return np.unpackbits(bytes_, axis=-1, bitorder="little")[..., 1:-1].astype(bool)


def count_voxels(mask: NDArray[Any]) -> NDArray[Any]:
    """Voxels set in each block of a mask [M, 30, 30]: int64 [M]."""
    counts: NDArray[Any] = _POPCOUNT[np.ascontiguousarray(mask).view(np.uint8)].sum(axis=(1, 2), dtype=np.int64)
    return counts


def block_coordinates(indirection: NDArray[Any]) -> NDArray[Any]:
    """Coordinates [M, 3] of the numbered blocks, in the order of their numbers. indirection: int32 [bx, by, bz], -1 where there is none."""
    coordinates = np.argwhere(indirection >= 0)
    return coordinates[np.argsort(indirection[indirection >= 0])]


def number_blocks(used: NDArray[Any]) -> NDArray[Any]:
    """An indirection grid int32 [bx, by, bz] that numbers the True blocks of `used`, bool of that shape, z fastest; -1 elsewhere."""
    indirection = np.full(used.shape, -1, np.int32)
    indirection[used] = np.arange(int(used.sum()), dtype=np.int32)
    return indirection


def blocks_in_ranges(first: NDArray[Any], last: NDArray[Any], blocks: tuple[int, ...]) -> NDArray[Any]:
    """bool [bx, by, bz]: blocks that lie in any of N boxes of blocks. first, last: [N, 3] corner blocks of the boxes, both included.

    A 3-D difference array: each box adds +1 or -1 at its 8 corners, and cumulative sums along the axes fill it. The time does not depend
    on the size of the boxes. Parts outside the grid are ignored.
    """
    first, last = np.maximum(first, 0), np.minimum(last, np.array(blocks) - 1)
    not_empty = (first <= last).all(axis=-1)
    corners = np.stack([first[not_empty], last[not_empty] + 1])
    wide = tuple(size + 1 for size in blocks)
    difference = np.zeros(int(np.prod(wide)), np.int64)
    for corner in product((0, 1), repeat=3):
        index = np.ravel_multi_index(tuple(corners[side, :, axis] for axis, side in enumerate(corner)), wide)
        difference += (-1) ** sum(corner) * np.bincount(index, minlength=len(difference))
    count = difference.reshape(wide)
    for axis in range(3):
        count = count.cumsum(axis=axis)
    return count[:-1, :-1, :-1] > 0


def reindex_blocks(values: NDArray[Any], old: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
    """Values [M, ...] of the blocks of the indirection grid `old`, as [M', ...] of those of `new`; 0 for blocks that `old` lacks."""
    moved = np.zeros((int(new.max(initial=-1)) + 1, *values.shape[1:]), values.dtype)
    both = (new >= 0) & (old >= 0)
    moved[new[both]] = values[old[both]]
    return moved


def dilate(mask: NDArray[Any], indirection: NDArray[Any]) -> NDArray[Any]:
    """A mask [M, 30, 30] dilated by one voxel in the maximum norm, across block borders, within the numbered blocks."""
    wide = np.zeros((len(mask), CELL_VOXELS, CELL_VOXELS), np.uint32)
    wide[:, 1:-1, 1:-1] = mask
    for here, there, (x, y, z) in _neighbours(indirection, np.arange(len(mask))):
        columns, lines = _face((x, y))
        row = mask[there, columns, lines]
        row = (row >> np.uint32(DATA_VOXELS) & np.uint32(1), row, (row & FIRST_BIT) << np.uint32(DATA_VOXELS))[z + 1]
        columns, lines = _apron((x, y))
        wide[here, columns, lines] |= row
    wide |= wide << np.uint32(1) | wide >> np.uint32(1)
    wide = wide[:, 1:-1] | wide[:, 2:] | wide[:, :-2]
    dilated: NDArray[Any] = (wide[:, :, 1:-1] | wide[:, :, 2:] | wide[:, :, :-2]) & OWN_BITS
    return dilated


def touched_blocks(mask: NDArray[Any], indirection: NDArray[Any]) -> NDArray[Any]:
    """bool [bx, by, bz]: blocks whose 32^3 voxels, apron included, contain a voxel of a mask [M, 30, 30].

    A block without voxels of its own needs a cell too if its apron holds one: half of that voxel's stencils lie in it (hard case 34).
    """
    coordinates = block_coordinates(indirection)
    touched = np.zeros(tuple(n + 2 for n in indirection.shape), bool)
    for offset in ((0, 0, 0), *NEIGHBOUR_OFFSETS):
        x, y, z = (-o for o in offset)  # a voxel on this block's side towards `offset` is in the apron of the block there
        columns, lines = _face((x, y))
        row = mask[:, columns, lines] & (LAST_BIT, OWN_BITS, FIRST_BIT)[z + 1]
        touched[tuple((coordinates[row.any(axis=(1, 2))] + 1 + np.array(offset)).T)] = True
    return touched[1:-1, 1:-1, 1:-1]


def fill_aprons(cells: NDArray[Any], indirection: NDArray[Any]) -> Iterator[int]:
    """Copy the border voxels of neighbouring blocks into the aprons of cells [M, 32, 32, 32, ...], in place.

    indirection: int32 [bx, by, bz], a block's row in `cells`. An apron towards a block without a cell is left as it is. Yields after
    each chunk how many cells are done so far.
    """
    for start in range(0, len(cells), BLOCKS_PER_CHUNK):
        rows = np.arange(start, min(start + BLOCKS_PER_CHUNK, len(cells)))
        for here, there, offset in _neighbours(indirection, rows):
            to, source = _apron(offset), _face(offset, 1)
            cells[rows[here], to[0], to[1], to[2]] = cells[there, source[0], source[1], source[2]]
        yield int(rows[-1]) + 1


def _neighbours(indirection: NDArray[Any], rows: NDArray[Any]) -> Iterator[tuple[NDArray[Any], NDArray[Any], tuple[int, int, int]]]:
    """For each offset: which of the blocks with numbers `rows` [R] have a neighbour there (positions in `rows`), its number, the offset."""
    coordinates = block_coordinates(indirection)[rows]
    padded = np.pad(indirection, 1, constant_values=-1)
    for x, y, z in NEIGHBOUR_OFFSETS:
        neighbour = padded[coordinates[:, 0] + 1 + x, coordinates[:, 1] + 1 + y, coordinates[:, 2] + 1 + z]
        here = np.flatnonzero(neighbour >= 0)
        yield here, neighbour[here], (x, y, z)


def _apron(offset: tuple[int, ...]) -> tuple[slice, ...]:
    """The part of a cell's apron that the neighbour at an offset fills."""
    return tuple((slice(0, 1), slice(1, CELL_VOXELS - 1), slice(CELL_VOXELS - 1, CELL_VOXELS))[o + 1] for o in offset)


def _face(offset: tuple[int, ...], first: int = 0) -> tuple[slice, ...]:
    """The voxels that the neighbour at an offset contributes to that part; first: array index of the neighbour's own voxel 0."""
    faces = ((DATA_VOXELS - 1, DATA_VOXELS), (0, DATA_VOXELS), (0, 1))
    return tuple(slice(faces[o + 1][0] + first, faces[o + 1][1] + first) for o in offset)
