"""The slow, plain, float64 march that every other march is measured against: no skipping, no early stop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from snerg.core.geometry.camera import Camera
from snerg.core.geometry.ndc import Ndc
from snerg.core.nerf.frame import NETWORK_TRANSMITTANCE
from snerg.core.scene.blocks import CELL_VOXELS, DATA_VOXELS
from snerg.core.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Truth:
    """colour [H, W, 3] float64 premultiplied, view dependence included; transmittance [H, W]; depth [H, W]: the mean distance in
    world units (that of the mean place in NDC), infinite where nothing is. `composited` [H, W, C - 1]: colour and features
    before the network."""

    colour: np.ndarray
    transmittance: np.ndarray
    depth: np.ndarray
    composited: np.ndarray

    def over(self, background: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> np.ndarray:
        """[H, W, 3] in [0, 1]."""
        return np.clip(self.colour + self.transmittance[..., None] * np.array(background), 0, 1)


def dense_march(scene: Scene, camera: Camera, per_sample_network: bool = False) -> Truth:
    """Every sample of every ray, one after the other (sections 5.2 and 4.2)."""
    origins, directions = camera.rays()
    values, through, depth = dense_rays(scene, origins, directions, max(scene.near, camera.near), per_sample_network)
    colour = values[:, :3].copy()
    if scene.network is not None and not per_sample_network:
        seen = through <= NETWORK_TRANSMITTANCE
        white = colour + through[:, None]
        colour[seen] += residual(scene, white[seen], values[seen, 3:], directions[seen] @ scene.view_rotation.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(through < 1, depth / (1 - through), np.inf)
        if scene.ndc is not None:
            depth = world_depth(scene.ndc, origins, directions, depth, max(scene.near, camera.near))
    h, w = camera.height, camera.width
    return Truth(colour.reshape(h, w, 3), through.reshape(h, w), depth.reshape(h, w), values.reshape(h, w, -1))


def dense_rays(
    scene: Scene, origins: np.ndarray, directions: np.ndarray, near: float, per_sample_network: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Premultiplied values [N, C - 1], transmittance [N] and depth times opacity [N] of rays in the world; depth in units of
    the grid's space."""
    begins = near
    views = directions @ scene.view_rotation.T
    if scene.ndc is not None:
        origins, directions = device_rays(scene.ndc, origins, directions, near)
        begins = 0.0
    axes, corner = scene.grid_to_world[:3, :3], scene.grid_to_world[:3, 3]
    origin = (origins - corner) @ axes / scene.voxel_size
    direction = directions @ axes
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.stack([-origin / direction, (np.array(scene.shape) - origin) / direction])
    parallel = direction == 0
    inside = (origin >= 0) & (origin <= np.array(scene.shape))
    enters = np.where(parallel, np.where(inside, -np.inf, np.inf), walls.min(axis=0)).max(axis=-1)
    leaves = np.where(parallel, np.where(inside, np.inf, -np.inf), walls.max(axis=0)).min(axis=-1)
    start = np.maximum(enters, begins / scene.voxel_size)
    values = np.zeros((len(origin), scene.cells.shape[-1] - 1))
    through, depth = np.ones(len(origin)), np.zeros(len(origin))
    k = 0
    while True:
        t = start + 0.5 + k
        live = np.flatnonzero(t < leaves)
        if not len(live):
            return fill(values, through, depth) if scene.opacity_correction else (values, through, depth)
        sample = trilinear(scene, origin[live] + t[live, None] * direction[live])
        if per_sample_network:  # as a surface of the sample's own colour would look, alpha times
            alpha = sample[:, -1:]
            straight = sample[:, :-1] / np.where(alpha > 0, alpha, 1)
            sample[:, :3] += alpha * residual(scene, straight[:, :3], straight[:, 3:], views[live])
        values[live] += through[live, None] * sample[:, :-1]
        depth[live] += through[live] * sample[:, -1] * t[live] * scene.voxel_size
        through[live] *= 1 - sample[:, -1]
        k += 1


def fill(values: np.ndarray, through: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Equation 9: times min(1, 1.5 alpha) / alpha, where there is any."""
    factor = np.array([min(1, 1.5 * alpha) / alpha if alpha > 0 else 0.0 for alpha in 1 - through])
    return values * factor[:, None], 1 - factor * (1 - through), depth * factor


def device_rays(ndc: Ndc, origins: np.ndarray, directions: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Where rays begin in NDC and their unit directions there, by the formulas of NeRF's appendix C; a miss begins far outside."""
    axes, position = ndc.camera_to_world[:3, :3], ndc.camera_to_world[:3, 3]
    origin, (dx, dy, dz) = (origins - position) @ axes, (directions @ axes).T
    seen = dz < -1e-6
    dz = np.where(seen, dz, -1)
    t = np.maximum(near, -(ndc.near + origin[:, 2]) / dz)
    ox, oy, oz = (origin + t[:, None] * np.stack([dx, dy, dz], axis=-1)).T
    fx, fy = ndc.focal
    start = np.stack([-fx * ox / oz, -fy * oy / oz, 1 + 2 * ndc.near / oz], axis=-1)
    along = np.stack([-fx * (dx / dz - ox / oz), -fy * (dy / dz - oy / oz), -2 * ndc.near / oz], axis=-1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    return np.where(seen[:, None], start, 1e6), np.where(seen[:, None], along, [0, 0, 1.0])


def world_depth(ndc: Ndc, origins: np.ndarray, directions: np.ndarray, distance: np.ndarray, near: float) -> np.ndarray:
    """World distance [N] of places at a distance [N] along the rays' images in NDC."""
    start, along = device_rays(ndc, origins, directions, near)
    x, y, z = (start + distance[:, None] * along).T
    depth = -2 * ndc.near / (z - 1)
    local = np.stack([x * depth / ndc.focal[0], y * depth / ndc.focal[1], -depth], axis=-1)
    return np.linalg.norm(local @ ndc.camera_to_world[:3, :3].T + ndc.camera_to_world[:3, 3] - origins, axis=-1)


def trilinear(scene: Scene, points: np.ndarray) -> np.ndarray:
    """[N, 3] voxel coordinates inside the grid to [N, C] in [0, 1]; nothing in blocks without a cell."""
    block = np.clip(np.floor(points / DATA_VOXELS).astype(int), 0, np.array(scene.indirection.shape) - 1)
    cell = scene.indirection[tuple(block.T)]
    result = np.zeros((len(points), scene.cells.shape[-1]))
    full = np.flatnonzero(cell >= 0)
    local = points[full] - DATA_VOXELS * block[full] + 0.5
    base = np.clip(np.floor(local).astype(int), 0, CELL_VOXELS - 2)
    fraction = local - base
    for offset in np.ndindex(2, 2, 2):
        weight = np.where(np.array(offset) > 0, fraction, 1 - fraction).prod(axis=-1)
        x, y, z = (base + np.array(offset)).T
        result[full] += weight[:, None] * scene.cells[cell[full], x, y, z] / (255 if scene.cells.dtype == np.uint8 else 1)
    return result


def residual(scene: Scene, colour: np.ndarray, features: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Equation 7, written out in float64."""
    network = [np.asarray(a, np.float64) for a in scene.network or ()]
    waves = [f(2.0**k * directions) for f in (np.sin, np.cos) for k in range(4)]
    x = np.concatenate([directions, *waves, colour, features], axis=-1)
    x = np.maximum(x @ network[0] + network[1], 0)
    x = np.maximum(x @ network[2] + network[3], 0)
    return 1 / (1 + np.exp(-(x @ network[4] + network[5])))
