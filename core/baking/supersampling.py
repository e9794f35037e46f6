"""Supersampling of voxels: averaging the field over several points of each voxel, and choosing how many points pay."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..nerf.field import Field
from ..nerf.volume_rendering import opacity, optical_depth
from ..scene.blocks import DATA_VOXELS, block_coordinates, unpack_mask
from ..scene.voxel_grid import VoxelGrid
from .jitter import voxel_normal

MAX_SUPERSAMPLING = 16  # points a voxel that are tried at most
TEST_RAYS = 1000  # short rays by which the choice is made
TEST_RAY_VOXELS = 8  # length of a test ray, voxels
REFERENCE_SAMPLES_PER_VOXEL = 4  # points a voxel's length at which the field itself is composited: the reference of the error
MIN_GAIN = 0.02  # share by which doubling the points must reduce the error to be worth it
TEST_BLOCKS = 64  # blocks in which test rays begin: bounds what is unpacked


def choose_supersampling(
    field: Field, voxel_grid: VoxelGrid, mask: NDArray[Any], indirection: NDArray[Any], seed: int
) -> tuple[int, list[dict[str, Any]]]:
    """The least of 1, 2, 4, 8 and 16 points a voxel that doubling does not improve by MIN_GAIN.

    mask: voxels to bake, uint32 [M, 30, 30]; indirection: int32 [bx, by, bz]. Test rays of TEST_RAY_VOXELS start at random voxels of the
    mask in random directions. The error is the root mean square, over colour and transmittance of the rays, of the difference between the
    finely composited field and the interpolated baked voxels. Averaging reduces aliasing of detail finer than a voxel; a smooth field it
    only blurs, so the error has to decide.

    Returns the number and, for each number tried, {"samples": number, "error": root mean square}.
    """
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(len(mask), min(len(mask), TEST_BLOCKS), replace=False))
    row, *local = np.nonzero(unpack_mask(mask[rows]))
    if not len(row):
        return 1, []
    chosen = np.sort(rng.choice(len(row), min(len(row), TEST_RAYS), replace=False))
    start = block_coordinates(indirection)[rows[row[chosen]]] * DATA_VOXELS + np.stack(local, axis=-1)[chosen]
    return measure_supersampling(field, voxel_grid, start, rng, seed)


def measure_supersampling(
    field: Field, voxel_grid: VoxelGrid, start: NDArray[Any], rng: np.random.Generator, seed: int
) -> tuple[int, list[dict[str, Any]]]:
    """As `choose_supersampling`, with test rays that start at voxels with indices [N, 3]."""
    direction = rng.normal(size=start.shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    truth = composite(*field_along(field, voxel_grid, start, direction))

    def error(count: int) -> dict[str, Any]:
        baked = composite(*baked_along(field, voxel_grid, start, direction, count, seed))
        return {"samples": count, "error": round(float(np.sqrt(np.mean((baked - truth) ** 2))), 6)}

    count, evidence = 1, [error(1)]
    while count < MAX_SUPERSAMPLING:
        evidence.append(error(2 * count))
        if evidence[-1]["error"] > (1 - MIN_GAIN) * evidence[-2]["error"]:
            break
        count *= 2
    return count, evidence


def field_along(field: Field, voxel_grid: VoxelGrid, start: NDArray[Any], direction: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Premultiplied RGB [N, K, 3] and opacity [N, K] of the field at K points along test rays, REFERENCE_SAMPLES_PER_VOXEL to a voxel.

    start: [N, 3] in voxels; direction: [N, 3], unit vectors.
    """
    t = (np.arange(TEST_RAY_VOXELS * REFERENCE_SAMPLES_PER_VOXEL) + 0.5) / REFERENCE_SAMPLES_PER_VOXEL
    points = start[:, None] + direction[:, None] * t[:, None]
    density, rgb, _ = field.query(voxel_grid.voxel_centres(points.reshape(-1, 3)))
    alpha = opacity(np, optical_depth(np, density, np.float32(voxel_grid.voxel_size / REFERENCE_SAMPLES_PER_VOXEL)))
    return (rgb * alpha[:, None]).reshape(*points.shape), alpha.reshape(points.shape[:2])


def baked_along(
    field: Field, voxel_grid: VoxelGrid, start: NDArray[Any], direction: NDArray[Any], count: int, seed: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Premultiplied RGB [N, K, 3] and opacity [N, K] along test rays of voxels baked with `count` points each.

    start, direction: [N, 3], in voxels. The baked values are interpolated trilinearly at K = TEST_RAY_VOXELS samples, one voxel's edge
    length apart, as the ray marcher does.
    """
    points = (start[:, None] + direction[:, None] * (np.arange(TEST_RAY_VOXELS) + 0.5)[:, None]).reshape(-1, 3)
    base = np.floor(points).astype(np.int64)
    values: Any = 0.0
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, points - base, 1 - (points - base)).prod(axis=-1)
        colour, alpha = average_in_voxels(field, voxel_grid, np.maximum(base + corner, 0), count, seed)
        values = values + weight[:, None] * np.concatenate([colour[:, :3], alpha[:, None]], axis=-1)
    return values[:, :3].reshape(len(start), TEST_RAY_VOXELS, 3), values[:, 3].reshape(len(start), TEST_RAY_VOXELS)


def composite(colour: NDArray[Any], alpha: NDArray[Any]) -> NDArray[Any]:
    """Composite K samples of each ray front to back (eqs. 5, 6): premultiplied RGB and transmittance, [N, 4].

    colour: [N, K, 3], premultiplied; alpha: [N, K].
    """
    transmittance = np.cumprod(1 - alpha, axis=-1)
    in_front = np.concatenate([np.ones_like(transmittance[:, :1]), transmittance[:, :-1]], axis=-1)
    return np.concatenate([(in_front[..., None] * colour).sum(axis=1), transmittance[:, -1:]], axis=-1)


def average_in_voxels(
    field: Field, voxel_grid: VoxelGrid, voxels: NDArray[Any], count: int, seed: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Premultiplied RGB and features [N, C] and opacity [N] of voxels with indices [N, 3], averaged over `count` points each.

    The points are normally distributed about the voxel's centre with a standard deviation of voxel_size / sqrt(12), that of a uniform
    distribution over the voxel (section 5.3). They come in pairs of opposite offsets, so that no content moves on average (hard case 48);
    an odd one is the centre.

    Opacities along one voxel's length are averaged, and colours weighted by them, as in the reference implementation; the paper says
    density. A voxel half filled by a solid then stops half the light; with the mean density it would stop nearly all (hard case 49).
    """
    offsets = voxel_normal(voxels, count // 2, seed) / np.sqrt(12)
    signed: list[Any] = [sign * offsets[:, pair] for pair in range(count // 2) for sign in (1, -1)]
    if count % 2:
        signed.append(0.0)
    colour: Any = 0.0
    total = np.zeros(len(voxels), np.float32)
    for offset in signed:
        density, rgb, features = field.query(voxel_grid.voxel_centres(voxels + offset))
        alpha = opacity(np, optical_depth(np, density, np.float32(voxel_grid.voxel_size)))
        colour = colour + np.concatenate([rgb, features], axis=-1) * alpha[:, None]
        total += alpha
    return colour / np.float32(count), total / np.float32(count)
