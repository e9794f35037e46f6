"""Atlas cells to the pictures that hold them, and back (reference layout: four Z planes stacked in each picture)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..scene.blocks import CELL_VOXELS

PLANES = 4  # Z planes a picture
MAX_ATLAS_CELLS = 64  # along an axis: 2048 voxels, what every WebGL 2 device in use can hold


def atlas_blocks(cells: int) -> tuple[int, int, int]:
    """Cells along x, y and z of an atlas for that many cells: nearly a cube, none over 64, at least one.

    Raises SnergError when no such atlas holds them.
    """
    if cells > MAX_ATLAS_CELLS**3:
        raise SnergError(f"The scene has {cells} macroblocks; an atlas holds {MAX_ATLAS_CELLS**3}: bake at a lower resolution.")
    side = max(1, round(cells ** (1 / 3)))
    x = min(MAX_ATLAS_CELLS, side)
    y = min(MAX_ATLAS_CELLS, -(-cells // (x * side)) or 1)
    z = -(-cells // (x * y)) or 1
    return x, y, z


def slices(cells: NDArray[Any], blocks: tuple[int, int, int]) -> Iterator[NDArray[Any]]:
    """The atlas as pictures uint8 [4 * atlas_height, atlas_width, C], in Z order; cell i at (i % bx, i / bx % by, ...)."""
    bx, by, bz = blocks
    n, c = CELL_VOXELS, cells.shape[-1]
    for iz in range(bz):
        layer = np.zeros((by * bx, n, n, n, c), np.uint8)
        part = cells[iz * bx * by : (iz + 1) * bx * by]
        layer[: len(part)] = part
        # [iy, ix, x, y, z, c] -> [z, iy, y, ix, x, c]
        planes = layer.reshape(by, bx, n, n, n, c).transpose(4, 0, 3, 1, 2, 5).reshape(n, by * n, bx * n, c)
        for z in range(0, n, PLANES):
            yield planes[z : z + PLANES].reshape(PLANES * by * n, bx * n, c)


def cells_from_slices(read: Callable[[int], NDArray[Any]], blocks: tuple[int, int, int], count: int, channels: int) -> NDArray[Any]:
    """Undo `slices`: `read(i)` gives picture i; returns uint8 [count, 32, 32, 32, channels]."""
    bx, by, bz = blocks
    n = CELL_VOXELS
    cells = np.empty((bx * by * bz, n, n, n, channels), np.uint8)
    for iz in range(bz):
        pictures = [read(iz * n // PLANES + k) for k in range(n // PLANES)]
        planes = np.concatenate([p.reshape(PLANES, by * n, bx * n, channels) for p in pictures])
        layer = planes.reshape(n, by, n, bx, n, channels).transpose(1, 3, 4, 2, 0, 5)
        cells[iz * bx * by : (iz + 1) * bx * by] = layer.reshape(by * bx, n, n, n, channels)
    return cells[:count]
