"""Macroblocks: from blocks of 30^3 voxels of their own to atlas cells of 32^3 with an apron, and what needs neighbours."""

from __future__ import annotations

from itertools import product

import numpy as np

from .box import CELL_VOXELS, DATA_VOXELS

OFFSETS = tuple(product((-1, 0, 1), repeat=3))


def with_apron(own: np.ndarray, indirection: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
    """[M, 30, 30, 30, ...] to cells [R, 32, 32, 32, ...], the apron copied from neighbours, 0 where there is none.

    indirection: int32 [bx, by, bz], number of a block in `own` or -1. rows: the blocks wanted, all when None.
    """
    rows = np.arange(len(own)) if rows is None else rows
    cells = np.zeros((len(rows), *(CELL_VOXELS,) * 3, *own.shape[4:]), own.dtype)
    place = np.argwhere(indirection >= 0)[np.argsort(indirection[indirection >= 0])][rows]
    padded = np.pad(indirection, 1, constant_values=-1)
    for offset in OFFSETS:
        neighbour = padded[tuple((place + 1 + np.array(offset)).T)]
        there = np.flatnonzero(neighbour >= 0)
        to = tuple(_target(o) for o in offset)
        source = tuple(_source(o) for o in offset)
        cells[(there, *to)] = own[(neighbour[there], *source)]
    return cells


def _target(offset: int) -> slice:
    return (slice(0, 1), slice(1, CELL_VOXELS - 1), slice(CELL_VOXELS - 1, CELL_VOXELS))[offset + 1]


def _source(offset: int) -> slice:
    return (slice(DATA_VOXELS - 1, DATA_VOXELS), slice(0, DATA_VOXELS), slice(0, 1))[offset + 1]


def dilate(own: np.ndarray, indirection: np.ndarray, times: int) -> np.ndarray:
    """bool [M, 30, 30, 30] grown by `times` voxels in the maximum norm, across block borders."""
    for _ in range(times):
        wide = with_apron(own, indirection)
        for axis in (1, 2, 3):
            ahead, back, here = ([slice(None)] * 4 for _ in range(3))
            ahead[axis], back[axis], here[axis] = slice(2, None), slice(None, -2), slice(1, -1)
            wide = wide[tuple(here)] | wide[tuple(ahead)] | wide[tuple(back)]
        own = wide
    return own


def number(mask: np.ndarray) -> np.ndarray:
    """bool [bx, by, bz] to int32: blocks that are kept numbered x, then y, then z (z fastest), others -1."""
    indirection = np.full(mask.shape, -1, np.int32)
    indirection[mask] = np.arange(int(mask.sum()), dtype=np.int32)
    return indirection


def cells_of(own: np.ndarray, indirection: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Blocks uint8 [M, 30, 30, 30, C] to (atlas cells, their indirection grid).

    A cell is kept when anything in its 32^3 is not 0, so that half a tent in a neighbour without voxels of its own
    is not lost (hard case 34); one with nothing is dropped.
    """
    full = own.reshape(len(own), *(DATA_VOXELS,) * 3, own.shape[-1]).any(axis=-1)
    needed = np.zeros(tuple(n + 2 for n in indirection.shape), bool)
    place = np.argwhere(indirection >= 0)
    for offset in OFFSETS:
        # A voxel on this block's side towards `offset` is in the apron of the block there.
        side = tuple(_source(-o) for o in offset)
        touches = full[(indirection[tuple(place.T)], *side)].any(axis=(1, 2, 3))
        needed[tuple((place[touches] + 1 + np.array(offset)).T)] = True
    kept = number(needed[1:-1, 1:-1, 1:-1])
    grown = np.zeros((int(kept.max(initial=-1)) + 1, *own.shape[1:]), own.dtype)
    both = (kept >= 0) & (indirection >= 0)
    grown[kept[both]] = own[indirection[both]]
    return with_apron(grown, kept), kept
