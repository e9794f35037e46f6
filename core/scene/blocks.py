"""Macroblocks: 30^3 voxels of their own, and what needs their neighbours.

A mask of voxels takes a word a row: uint32 [M, 30, 30], voxel z in bit z + 1, which leaves bits 0 and 31 for the apron. So masks
of a whole grid stay small, and growing one is a few shifts.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

DATA_VOXELS = 30  # a macroblock's own voxels along an axis
CELL_VOXELS = 32  # with the apron of one voxel on each side, as stored in the atlas
NEIGHBOUR_OFFSETS = tuple(offset for offset in product((-1, 0, 1), repeat=3) if any(offset))
OWN_BITS = np.uint32(0x7FFFFFFE)
FIRST_BIT, LAST_BIT = np.uint32(1 << 1), np.uint32(1 << DATA_VOXELS)
BLOCKS_PER_CHUNK = 64  # blocks worked on together where a loop goes over all
_POPCOUNT = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1)


def pack_mask(own: NDArray[Any]) -> NDArray[Any]:
    """bool [M, 30, 30, 30] to uint32 [M, 30, 30]."""
    wide = np.pad(own, ((0, 0), (0, 0), (0, 0), (1, 1)))
    return np.packbits(wide, axis=-1, bitorder="little").view("<u4")[..., 0].astype(np.uint32)


def unpack_mask(bits: NDArray[Any]) -> NDArray[Any]:
    """uint32 [M, 30, 30] to bool [M, 30, 30, 30]."""
    bytes_ = np.ascontiguousarray(bits).astype("<u4")[..., None].view(np.uint8)
    return np.unpackbits(bytes_, axis=-1, bitorder="little")[..., 1:-1].astype(bool)


def count_voxels(bits: NDArray[Any]) -> NDArray[Any]:
    """Voxels set in each block of a mask [M, 30, 30], int64 [M]."""
    return _POPCOUNT[np.ascontiguousarray(bits).view(np.uint8)].sum(axis=(1, 2), dtype=np.int64)


def block_coordinates(indirection: NDArray[Any]) -> NDArray[Any]:
    """Place [M, 3] of each block by its number; indirection: int32 [bx, by, bz], -1 where there is none."""
    place = np.argwhere(indirection >= 0)
    return place[np.argsort(indirection[indirection >= 0])]


def number_blocks(mask: NDArray[Any]) -> NDArray[Any]:
    """bool [bx, by, bz] to int32: blocks that are kept numbered x, then y, then z (z fastest), others -1."""
    indirection = np.full(mask.shape, -1, np.int32)
    indirection[mask] = np.arange(int(mask.sum()), dtype=np.int32)
    return indirection


def blocks_in_ranges(first: NDArray[Any], last: NDArray[Any], blocks: tuple[int, ...]) -> NDArray[Any]:
    """bool [bx, by, bz]: blocks in any of the ranges from places first to last [N, 3], both included, as far as they are in the grid.

    Each range is +1 and -1 at its corners, and sums along the axes fill it: as quick for one block a range as for the whole grid.
    """
    first, last = np.maximum(first, 0), np.minimum(last, np.array(blocks) - 1)
    kept = (first <= last).all(axis=-1)
    ends = np.stack([first[kept], last[kept] + 1])
    wide = tuple(size + 1 for size in blocks)
    count = np.zeros(int(np.prod(wide)), np.int64)
    for corner in product((0, 1), repeat=3):
        place = np.ravel_multi_index(tuple(ends[end, :, axis] for axis, end in enumerate(corner)), wide)
        count += (-1) ** sum(corner) * np.bincount(place, minlength=len(count))
    filled = count.reshape(wide)
    for axis in range(3):
        filled = filled.cumsum(axis=axis)
    return filled[:-1, :-1, :-1] > 0


def reindex_blocks(values: NDArray[Any], old: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
    """Rows [M, ...] of one indirection grid as those of another, 0 for blocks that the old one lacks."""
    moved = np.zeros((int(new.max(initial=-1)) + 1, *values.shape[1:]), values.dtype)
    both = (new >= 0) & (old >= 0)
    moved[new[both]] = values[old[both]]
    return moved


def dilate(bits: NDArray[Any], indirection: NDArray[Any]) -> NDArray[Any]:
    """A mask [M, 30, 30] grown by a voxel in the maximum norm, across block borders."""
    wide = np.zeros((len(bits), CELL_VOXELS, CELL_VOXELS), np.uint32)
    wide[:, 1:-1, 1:-1] = bits
    for here, there, (x, y, z) in _neighbours(indirection, np.arange(len(bits))):
        columns, lines = _face((x, y))
        row = bits[there, columns, lines]
        row = (row >> np.uint32(DATA_VOXELS) & np.uint32(1), row, (row & FIRST_BIT) << np.uint32(DATA_VOXELS))[z + 1]
        columns, lines = _apron((x, y))
        wide[here, columns, lines] |= row
    wide |= wide << np.uint32(1) | wide >> np.uint32(1)
    wide = wide[:, 1:-1] | wide[:, 2:] | wide[:, :-2]
    return (wide[:, :, 1:-1] | wide[:, :, 2:] | wide[:, :, :-2]) & OWN_BITS


def touched_blocks(bits: NDArray[Any], indirection: NDArray[Any]) -> NDArray[Any]:
    """bool [bx, by, bz]: blocks in whose 32^3 a voxel of a mask [M, 30, 30] lies, their own or a neighbour's.

    Half a tent lies in a neighbour that may have no voxels of its own (hard case 34).
    """
    place = block_coordinates(indirection)
    reached = np.zeros(tuple(n + 2 for n in indirection.shape), bool)
    for offset in ((0, 0, 0), *NEIGHBOUR_OFFSETS):
        x, y, z = (-o for o in offset)  # a voxel on this block's side towards `offset` is in the apron of the block there
        columns, lines = _face((x, y))
        row = bits[:, columns, lines] & (LAST_BIT, OWN_BITS, FIRST_BIT)[z + 1]
        reached[tuple((place[row.any(axis=(1, 2))] + 1 + np.array(offset)).T)] = True
    return reached[1:-1, 1:-1, 1:-1]


def fill_aprons(cells: NDArray[Any], indirection: NDArray[Any]) -> Iterator[int]:
    """Copy into the aprons of cells [M, 32, 32, 32, ...] their neighbours' voxels, in place; yields how many cells are done."""
    for start in range(0, len(cells), BLOCKS_PER_CHUNK):
        rows = np.arange(start, min(start + BLOCKS_PER_CHUNK, len(cells)))
        for here, there, offset in _neighbours(indirection, rows):
            to, source = _apron(offset), _face(offset, 1)
            cells[rows[here], to[0], to[1], to[2]] = cells[there, source[0], source[1], source[2]]
        yield int(rows[-1]) + 1


def _neighbours(indirection: NDArray[Any], rows: NDArray[Any]) -> Iterator[tuple[NDArray[Any], NDArray[Any], tuple[int, int, int]]]:
    """For each offset (x, y, z): which of the blocks `rows` have a neighbour there, its number, and the offset."""
    place = block_coordinates(indirection)[rows]
    padded = np.pad(indirection, 1, constant_values=-1)
    for x, y, z in NEIGHBOUR_OFFSETS:
        neighbour = padded[place[:, 0] + 1 + x, place[:, 1] + 1 + y, place[:, 2] + 1 + z]
        here = np.flatnonzero(neighbour >= 0)
        yield here, neighbour[here], (x, y, z)


def _apron(offset: tuple[int, ...]) -> tuple[slice, ...]:
    """Where in a cell the voxels of the neighbour at an offset go."""
    return tuple((slice(0, 1), slice(1, CELL_VOXELS - 1), slice(CELL_VOXELS - 1, CELL_VOXELS))[o + 1] for o in offset)


def _face(offset: tuple[int, ...], first: int = 0) -> tuple[slice, ...]:
    """Which of its own voxels the neighbour at an offset gives; first: index of its first one."""
    faces = ((DATA_VOXELS - 1, DATA_VOXELS), (0, DATA_VOXELS), (0, 1))
    return tuple(slice(faces[o + 1][0] + first, faces[o + 1][1] + first) for o in offset)
