"""A scene at a quarter of its resolution, to show something before the whole has arrived."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .blocks import CELL_VOXELS, DATA_VOXELS, block_coordinates, fill_aprons, number_blocks, pack_mask, reindex_blocks, touched_blocks
from .scene import Scene, blocks_of

FACTOR = 4  # voxels along an axis that become one; a coarse block then covers 4^3 whole blocks


def coarse_scene(scene: Scene) -> Scene:
    """A quantised scene with voxels four times as long, from the same corner. Its `about` is empty.

    A coarse voxel has the mean of its voxels: of opacity a, premultiplied colour and features. A ray crosses four of them where it crosses
    one coarse voxel, so that its opacity is 1 - (1 - a)^4 and colour and features grow alike.
    """
    x, y, z = (-(-n // FACTOR) for n in scene.shape)
    shape = (x, y, z)
    fine = block_coordinates(scene.indirection)
    used = np.zeros(blocks_of(shape), bool)
    used[tuple((fine // FACTOR).T)] = True
    indirection = number_blocks(used)
    values = np.zeros((int(used.sum()), *(DATA_VOXELS,) * 3, scene.cells.shape[-1]), np.uint8)
    numbers = indirection[tuple((fine // FACTOR).T)]  # of the coarse block in which each fine one lies
    inside = np.split(np.argsort(numbers, kind="stable"), np.cumsum(np.bincount(numbers, minlength=len(values)))[:-1])
    for row, rows in enumerate(inside[: len(values)]):
        values[row] = _mean_block(scene, fine[rows] % FACTOR, rows)
    kept = number_blocks(touched_blocks(pack_mask(values.any(axis=-1)), indirection))
    own = reindex_blocks(values, indirection, kept)
    cells = np.zeros((len(own), *(CELL_VOXELS,) * 3, own.shape[-1]), np.uint8)
    cells[:, 1:-1, 1:-1, 1:-1] = own
    for _ in fill_aprons(cells, kept):
        pass
    return replace(scene, voxel_size=FACTOR * scene.voxel_size, shape=shape, indirection=kept, cells=cells, about={})


def _mean_block(scene: Scene, places: NDArray[np.intp], rows: NDArray[np.intp]) -> NDArray[np.uint8]:
    """The voxels [30, 30, 30, C] of a coarse block. places [n, 3]: of its blocks within it, 0 to 3; rows [n]: their cells."""
    whole = np.zeros((*(FACTOR * DATA_VOXELS,) * 3, scene.cells.shape[-1]), np.uint8)
    for (x, y, z), row in zip(places * DATA_VOXELS, rows, strict=True):
        whole[x : x + DATA_VOXELS, y : y + DATA_VOXELS, z : z + DATA_VOXELS] = scene.cells[row, 1:-1, 1:-1, 1:-1]
    split = scene.linear(whole).reshape(DATA_VOXELS, FACTOR, DATA_VOXELS, FACTOR, DATA_VOXELS, FACTOR, -1)
    mean = split.sum(axis=(1, 3, 5), dtype=np.uint32) / np.float32(scene.unit * FACTOR**3)
    alpha = mean[..., -1:]
    combined = 1 - (1 - alpha) ** FACTOR
    mean *= combined / np.maximum(alpha, 1e-6)
    mean[..., -1:] = combined
    if scene.square_roots:
        mean = np.sqrt(mean)
    coarse: NDArray[np.uint8] = np.rint(255 * mean).astype(np.uint8)
    return coarse
