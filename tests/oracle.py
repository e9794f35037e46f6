"""A simple, slow ray march in float64, the reference for all others: no empty-space skipping, no early termination."""

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
    """A rendered picture, float64.

    colour: [H, W, 3] premultiplied, with view dependence. transmittance: [H, W]. depth: [H, W] expected distance in world units (in NDC:
    the distance of the expected position), infinite in empty pixels. composited: [H, W, C - 1] colour and features before the network.
    """

    colour: np.ndarray
    transmittance: np.ndarray
    depth: np.ndarray
    composited: np.ndarray

    def over(self, background: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> np.ndarray:
        """The picture over a background colour, [H, W, 3] in [0, 1]."""
        return np.clip(self.colour + self.transmittance[..., None] * np.array(background), 0, 1)


def dense_march(scene: Scene, camera: Camera, per_sample_network: bool = False, ends: np.ndarray | None = None) -> Truth:
    """Render a scene by visiting every sample of every ray (sections 5.2 and 4.2).

    ends: [H, W] depths along the view axis at which rays end, in place of the camera's far plane.
    """
    origins, directions = camera.rays()
    cosines = directions @ -camera.camera_to_world[:3, 2]  # near and far are planes, as Blender's clip start and end
    if camera.projection in ("equirectangular", "fisheye"):  # and spheres for these
        cosines = np.ones(len(directions))
    near, far = np.maximum(scene.near, camera.near / cosines), (camera.far if ends is None else ends.reshape(-1)) / cosines
    values, transmittance, depth = dense_rays(scene, origins, directions, near, per_sample_network, far)
    colour = values[:, :3].copy()
    if scene.network is not None and not per_sample_network:
        seen = transmittance <= NETWORK_TRANSMITTANCE
        white = colour + transmittance[:, None]
        colour[seen] += residual(scene, white[seen], values[seen, 3:], directions[seen] @ scene.view_rotation.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(transmittance < 1, depth / (1 - transmittance), np.inf)
        if scene.ndc is not None:
            depth = world_depth(scene.ndc, origins, directions, depth, near)
    h, w = camera.height, camera.width
    return Truth(colour.reshape(h, w, 3), transmittance.reshape(h, w), depth.reshape(h, w), values.reshape(h, w, -1))


def halfway_depth(scene: Scene, camera: Camera, ends: np.ndarray | None = None) -> np.ndarray:
    """Depth along the view axis [H, W] of the first sample behind which less than half of the light is left; infinite where more is.

    ends: [H, W] depths at which rays end, in place of the camera's far plane.
    """
    origins, directions = camera.rays()
    cosines = directions @ -camera.camera_to_world[:3, 2]
    near = np.maximum(scene.near, camera.near / cosines)
    far = (np.full(len(origins), camera.far) if ends is None else ends.reshape(-1)) / cosines
    reached = dense_rays(scene, origins, directions, near, far=far, until=0.5)[2]
    if scene.ndc is not None:
        found = np.flatnonzero(np.isfinite(reached))
        near = np.broadcast_to(near, reached.shape)
        reached[found] = world_depth(scene.ndc, origins[found], directions[found], reached[found], near[found])
    return (reached * cosines).reshape(camera.height, camera.width)


def dense_rays(
    scene: Scene,
    origins: np.ndarray,
    directions: np.ndarray,
    near: float | np.ndarray,
    per_sample_network: bool = False,
    far: float | np.ndarray = np.inf,
    until: float | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """March rays of the world: premultiplied values [N, C - 1], transmittance [N] and depth times opacity [N], in the grid's units.

    until: rays end behind the sample that leaves less than this of the light; the third array then holds its distance, or infinity.
    """
    begins, ends = near, far
    views = directions @ scene.view_rotation.T
    if scene.ndc is not None:
        last = device_points(scene.ndc, origins + np.where(np.isfinite(far), far, 0)[..., None] * directions)
        origins, directions = device_rays(scene.ndc, origins, directions, near)
        begins, ends = 0.0, np.where(np.isfinite(far), ((last - origins) * directions).sum(axis=-1), np.inf)
    axes, corner = scene.grid_to_world[:3, :3], scene.grid_to_world[:3, 3]
    origin = (origins - corner) @ axes / scene.voxel_size
    direction = directions @ axes
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.stack([-origin / direction, (np.array(scene.shape) - origin) / direction])
    parallel = direction == 0
    inside = (origin >= 0) & (origin <= np.array(scene.shape))
    enters = np.where(parallel, np.where(inside, -np.inf, np.inf), walls.min(axis=0)).max(axis=-1)
    leaves = np.where(parallel, np.where(inside, np.inf, -np.inf), walls.max(axis=0)).min(axis=-1)
    leaves = np.minimum(leaves, ends / scene.voxel_size)
    start = np.maximum(enters, begins / scene.voxel_size)
    values = np.zeros((len(origin), scene.cells.shape[-1] - 1))
    transmittance, depth, last_sample = np.ones(len(origin)), np.zeros(len(origin)), np.zeros(len(origin))
    k = 0
    while True:
        t = start + 0.5 + k
        live = np.flatnonzero((t < leaves) & (transmittance >= (until or 0)))
        if not len(live) and until is not None:
            return values, transmittance, np.where(transmittance < until, last_sample, np.inf)
        if not len(live):
            return correct_opacity(values, transmittance, depth) if scene.opacity_correction else (values, transmittance, depth)
        sample = trilinear(scene, origin[live] + t[live, None] * direction[live])
        if per_sample_network:  # alpha times the residual of a surface with the sample's straight colour
            alpha = sample[:, -1:]
            straight = sample[:, :-1] / np.where(alpha > 0, alpha, 1)
            sample[:, :3] += alpha * residual(scene, straight[:, :3], straight[:, 3:], views[live])
        values[live] += transmittance[live, None] * sample[:, :-1]
        depth[live] += transmittance[live] * sample[:, -1] * t[live] * scene.voxel_size
        transmittance[live] *= 1 - sample[:, -1]
        last_sample[live] = t[live] * scene.voxel_size
        k += 1


def correct_opacity(values: np.ndarray, transmittance: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Opacity correction (eq. 9): values, opacity and depth times min(1, 1.5 alpha) / alpha, where alpha is not 0."""
    factor = np.array([min(1, 1.5 * alpha) / alpha if alpha > 0 else 0.0 for alpha in 1 - transmittance])
    return values * factor[:, None], 1 - factor * (1 - transmittance), depth * factor


def device_rays(ndc: Ndc, origins: np.ndarray, directions: np.ndarray, near: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions [N, 3] of rays in NDC (NeRF, appendix C); rays that miss the frame start far outside the grid."""
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


def device_points(ndc: Ndc, points: np.ndarray) -> np.ndarray:
    """Points [N, 3] of the world in NDC (NeRF, appendix C)."""
    x, y, z = ((points - ndc.camera_to_world[:3, 3]) @ ndc.camera_to_world[:3, :3]).T
    z = np.minimum(z, -1e-9)
    return np.stack([-ndc.focal[0] * x / z, -ndc.focal[1] * y / z, 1 + 2 * ndc.near / z], axis=-1)


def world_depth(ndc: Ndc, origins: np.ndarray, directions: np.ndarray, distance: np.ndarray, near: float | np.ndarray) -> np.ndarray:
    """World distance [N] of the points at a distance [N] along the rays in NDC."""
    start, along = device_rays(ndc, origins, directions, near)
    x, y, z = (start + distance[:, None] * along).T
    depth = -2 * ndc.near / (z - 1)
    local = np.stack([x * depth / ndc.focal[0], y * depth / ndc.focal[1], -depth], axis=-1)
    return np.linalg.norm(local @ ndc.camera_to_world[:3, :3].T + ndc.camera_to_world[:3, 3] - origins, axis=-1)


def trilinear(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Interpolate at points [N, 3], in voxels inside the grid: [N, C] in [0, 1]; 0 in blocks without a cell."""
    block = np.clip(np.floor(points / DATA_VOXELS).astype(int), 0, np.array(scene.indirection.shape) - 1)
    cell = scene.indirection[tuple(block.T)]
    result = np.zeros((len(points), scene.cells.shape[-1]))
    full = np.flatnonzero(cell >= 0)
    local = points[full] - DATA_VOXELS * block[full] + 0.5
    base = np.clip(np.floor(local).astype(int), 0, CELL_VOXELS - 2)
    near = (1 - (local - base), local - base)  # weights [N, 3] of the lower and of the upper voxel along each axis
    steps = CELL_VOXELS ** np.arange(2, -1, -1)
    voxels, first = scene.cells.reshape(-1, scene.cells.shape[-1]), cell[full] * CELL_VOXELS**3 + base @ steps
    found = np.zeros((len(full), voxels.shape[-1]))
    for x, y, z in np.ndindex(2, 2, 2):
        weight = near[x][:, 0] * near[y][:, 1] * near[z][:, 2]
        stored = voxels[first + steps @ (x, y, z)] / (255 if scene.cells.dtype == np.uint8 else 1)
        found += weight[:, None] * (stored**2 if scene.square_roots else stored)
    result[full] = found
    return result


def residual(scene: Scene, colour: np.ndarray, features: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The view-dependent residual (eq. 7) in float64, [N, 3]."""
    network = [np.asarray(a, np.float64) for a in scene.network or ()]
    waves = [f(2.0**k * directions) for f in (np.sin, np.cos) for k in range(4)]
    x = np.concatenate([directions, *waves, colour, features], axis=-1)
    x = np.maximum(x @ network[0] + network[1], 0)
    x = np.maximum(x @ network[2] + network[3], 0)
    with np.errstate(over="ignore"):  # of a strong network: 1 / (1 + inf) is 0, as it should be
        return 1 / (1 + np.exp(-(x @ network[4] + network[5])))
