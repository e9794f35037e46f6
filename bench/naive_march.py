"""A straightforward vectorised march, to compare the real one with: every sample of every ray, all rays together, no skipping."""

from __future__ import annotations

import numpy as np

from snerg.core.geometry.camera import Camera
from snerg.core.nerf.frame import Composited, shade
from snerg.core.rendering.packet_traversal import intersect_grid
from snerg.core.scene.blocks import CELL_VOXELS, DATA_VOXELS
from snerg.core.scene.scene import Scene


def naive_march(scene: Scene, camera: Camera) -> np.ndarray:
    """[H, W, 3] over white: what one writes first in NumPy, float32, without skipping, early stop, batches or threads."""
    origins, directions = camera.rays()
    entry, direction, start, stop = intersect_grid(scene, origins, directions, max(scene.near, camera.near))
    samples = np.ceil(stop - start - 0.5)
    values = np.zeros((len(samples), scene.cells.shape[-1] - 1), np.float32)
    through = np.ones(len(samples), np.float32)
    for k in range(int(samples.max())):
        rays = np.flatnonzero(k < samples)
        sample = trilinear(scene, (entry[:, rays] + np.float32(k + 0.5) * direction[:, rays]).T)
        values[rays] += through[rays, None] * sample[:, :-1]
        through[rays] *= 1 - sample[:, -1]
    found = Composited(values[:, :3], values[:, 3:], through, np.zeros_like(through))
    colour = shade(scene.network, found, directions @ scene.view_rotation.T)
    return np.clip(colour + through[:, None], 0, 1).reshape(camera.height, camera.width, 3)


def trilinear(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Points [N, 3] in voxels to values [N, C] in [0, 1]; nothing in blocks without a cell."""
    block = np.clip((points / DATA_VOXELS).astype(int), 0, np.array(scene.indirection.shape) - 1)
    cell = scene.indirection[tuple(block.T)]
    local = points - DATA_VOXELS * block + np.float32(0.5)
    base = np.clip(local.astype(int), 0, CELL_VOXELS - 2)
    fraction = local - base
    result = np.zeros((len(points), scene.cells.shape[-1]), np.float32)
    for offset in np.ndindex(2, 2, 2):
        weight = np.where(np.array(offset) > 0, fraction, 1 - fraction).prod(axis=-1) * (cell >= 0)
        x, y, z = (base + np.array(offset)).T
        result += weight[:, None].astype(np.float32) * scene.cells[cell, x, y, z]
    return result / np.float32(scene.unit)
