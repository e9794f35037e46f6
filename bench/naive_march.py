"""A straightforward vectorised ray march as a baseline: every sample of every ray, all rays together, no empty-space skipping."""

from __future__ import annotations

import numpy as np

from snerg.core.geometry.camera import Camera
from snerg.core.nerf.frame import Composited, shade
from snerg.core.rendering.packet_traversal import intersect_grid
from snerg.core.scene.blocks import CELL_VOXELS, DATA_VOXELS
from snerg.core.scene.scene import Scene


def naive_march(scene: Scene, camera: Camera) -> np.ndarray:
    """Render a scene over white, [H, W, 3] float32: plain NumPy without skipping, early termination, batches or threads."""
    origins, directions = camera.rays()
    entry, direction, start, stop = intersect_grid(scene, origins, directions, max(scene.near, camera.near))
    samples = np.ceil(stop - start - 0.5)
    values = np.zeros((len(samples), scene.cells.shape[-1] - 1), np.float32)
    transmittance = np.ones(len(samples), np.float32)
    for k in range(int(samples.max())):
        rays = np.flatnonzero(k < samples)
        sample = trilinear(scene, (entry[:, rays] + np.float32(k + 0.5) * direction[:, rays]).T)
        values[rays] += transmittance[rays, None] * sample[:, :-1]
        transmittance[rays] *= 1 - sample[:, -1]
    rays = Composited(values[:, :3], values[:, 3:], transmittance, np.zeros_like(transmittance))
    colour = shade(scene.network, rays, directions @ scene.view_rotation.T)
    return np.clip(colour + transmittance[:, None], 0, 1).reshape(camera.height, camera.width, 3)


def trilinear(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Interpolate at points [N, 3], in voxels: values [N, C] in [0, 1]; 0 in blocks without a cell."""
    block = np.clip((points / DATA_VOXELS).astype(int), 0, np.array(scene.indirection.shape) - 1)
    cell = scene.indirection[tuple(block.T)]
    local = points - DATA_VOXELS * block + np.float32(0.5)
    base = np.clip(local.astype(int), 0, CELL_VOXELS - 2)
    fraction = local - base
    result = np.zeros((len(points), scene.cells.shape[-1]), np.float32)
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(np.array(corner) > 0, fraction, 1 - fraction).prod(axis=-1) * (cell >= 0)
        x, y, z = (base + np.array(corner)).T
        result += weight[:, None].astype(np.float32) * scene.linear(scene.cells[cell, x, y, z])
    return result / np.float32(scene.unit)
