"""A scene of square roots (thin fog) stored with even levels, for formats that have no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..baking.jitter import voxel_uniform
from ..scene.blocks import DATA_VOXELS, block_coordinates, fill_aprons
from ..scene.quantize import quantize
from ..scene.scene import Scene

GRAINY = (
    "The published layout has even levels of alpha alone, and its viewer drops what is below half of one: thin fog is grainy or missing."
)


def with_even_levels(scene: Scene) -> Scene:
    """A scene of square roots as one that holds its values; its thin voxels are dithered anew (see `quantize`), always in the same way."""
    channels = scene.cells.shape[-1]
    cells = np.zeros_like(scene.cells)
    local = np.indices((DATA_VOXELS,) * 3).reshape(3, -1).T
    for cell, block in enumerate(block_coordinates(scene.indirection)):
        values = scene.linear(scene.cells[cell, 1:-1, 1:-1, 1:-1]).reshape(-1, channels) / np.float32(scene.unit)
        stored = quantize(values, voxel_uniform(block * DATA_VOXELS + local, channels, 1))
        cells[cell, 1:-1, 1:-1, 1:-1] = stored.reshape(*(DATA_VOXELS,) * 3, channels)
    for _ in fill_aprons(cells, scene.indirection):
        pass
    return replace(scene, cells=cells, square_roots=False)
