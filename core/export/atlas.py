"""The atlas cut into slices, and put together again: a slice is four Z planes, one below the other, as in the reference layout."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..scene.blocks import CELL_VOXELS

SLICE_PLANES = 4  # Z planes a slice: the reference layout's
MAX_ATLAS_CELLS = 64  # along an axis: 2048 voxels, the largest 3D texture that every WebGL 2 device in use supports


def atlas_blocks(cells: int) -> tuple[int, int, int]:
    """Cells along x, y and z of an atlas that holds `cells` cells: nearly a cube, from 1 to 64 along each axis.

    Raises SnergError when there are more than 64^3 cells.
    """
    if cells > MAX_ATLAS_CELLS**3:
        raise SnergError(f"The scene has {cells} macroblocks; an atlas holds {MAX_ATLAS_CELLS**3}: bake at a lower resolution.")
    side = max(1, round(cells ** (1 / 3)))
    x = min(MAX_ATLAS_CELLS, side)
    y = min(MAX_ATLAS_CELLS, -(-cells // (x * side)) or 1)
    z = -(-cells // (x * y)) or 1
    return x, y, z


def slice_count(blocks: tuple[int, int, int]) -> int:
    """How many slices an atlas of `blocks` cells along x, y and z has."""
    return blocks[2] * CELL_VOXELS // SLICE_PLANES


def atlas_slices(cells: NDArray[Any], blocks: tuple[int, int, int]) -> Iterator[NDArray[Any]]:
    """Yield the slices of an atlas in order of z. A slice is 4 planes of constant z, one below another: uint8 [4 * height, width, C].

    width and height are the atlas's extents along x and y in voxels; a row of the slice has constant y.
    cells: uint8 [M, 32, 32, 32, C], indexed x, y, z. blocks: (bx, by, bz), cells along x, y and z; cell i lies at
    (i % bx, i // bx % by, i // (bx * by)), and places past the last cell are 0.
    """
    bx, by, bz = blocks
    n, c = CELL_VOXELS, cells.shape[-1]
    for iz in range(bz):
        layer = np.zeros((by * bx, n, n, n, c), np.uint8)
        part = cells[iz * bx * by : (iz + 1) * bx * by]
        layer[: len(part)] = part
        # [iy, ix, x, y, z, c] -> [z, iy, y, ix, x, c]
        planes = layer.reshape(by, bx, n, n, n, c).transpose(4, 0, 3, 1, 2, 5).reshape(n, by * n, bx * n, c)
        for z in range(0, n, SLICE_PLANES):
            yield planes[z : z + SLICE_PLANES].reshape(SLICE_PLANES * by * n, bx * n, c)


def cells_from_slices(read: Callable[[int], NDArray[Any]], blocks: tuple[int, int, int], count: int, channels: int) -> NDArray[Any]:
    """The cells of an atlas, uint8 [count, 32, 32, 32, channels]: the inverse of `atlas_slices`.

    read: from an index to that slice, uint8 [4 * height, width, channels]; called in order. blocks: cells along x, y and z.
    """
    bx, by, bz = blocks
    n = CELL_VOXELS
    cells = np.empty((bx * by * bz, n, n, n, channels), np.uint8)
    for iz in range(bz):
        slices = [read(iz * n // SLICE_PLANES + k) for k in range(n // SLICE_PLANES)]
        planes = np.concatenate([pixels.reshape(SLICE_PLANES, by * n, bx * n, channels) for pixels in slices])
        layer = planes.reshape(n, by, n, bx, n, channels).transpose(1, 3, 4, 2, 0, 5)
        cells[iz * bx * by : (iz + 1) * bx * by] = layer.reshape(by * bx, n, n, n, channels)
    return cells[:count]
