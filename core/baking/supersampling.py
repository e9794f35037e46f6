"""How many samples a voxel are worth their time: measured on short rays, the field's own against what would be baked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..nerf.field import Field
from ..nerf.volume_rendering import opacity, optical_depth
from ..scene.blocks import DATA_VOXELS, block_coordinates, unpack_mask
from ..scene.voxel_grid import VoxelGrid
from .jitter import voxel_normal

MAX_SUPERSAMPLING = 16
TEST_RAYS = 1000
TEST_RAY_VOXELS = 8  # of a ray, voxels
REFERENCE_SAMPLES_PER_VOXEL = 4  # points of the field a voxel's length, which stand for the truth
MIN_GAIN = 0.02  # share of the error that doubling the samples must take away
TEST_BLOCKS = 64  # from which the rays are drawn


def choose_supersampling(
    field: Field, voxel_grid: VoxelGrid, bits: NDArray[Any], indirection: NDArray[Any], seed: int
) -> tuple[int, list[dict[str, Any]]]:
    """The least of 1, 2, 4, 8 and 16 samples that doubling does not make better by GAIN, and what was measured.

    Rays of LENGTH voxels begin at random in the mask [M, 30, 30] and go anywhere. What is measured is the root mean square over their
    colour and transmittance of the difference between the field, finely sampled, and the baked voxels, interpolated. More samples smooth
    what is finer than a voxel; where nothing is, they only blur it: so the error decides, and not how much the voxels change.
    Returns the number and [{"samples", "error"}].
    """
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(len(bits), min(len(bits), TEST_BLOCKS), replace=False))
    row, *local = np.nonzero(unpack_mask(bits[rows]))
    if not len(row):
        return 1, []
    some = np.sort(rng.choice(len(row), min(len(row), TEST_RAYS), replace=False))
    start = block_coordinates(indirection)[rows[row[some]]] * DATA_VOXELS + np.stack(local, axis=-1)[some]
    return measure_supersampling(field, voxel_grid, start, rng, seed)


def measure_supersampling(
    field: Field, voxel_grid: VoxelGrid, start: NDArray[Any], rng: np.random.Generator, seed: int
) -> tuple[int, list[dict[str, Any]]]:
    """`choose_samples` by rays that start at voxels [N, 3] of the lattice."""
    direction = rng.normal(size=start.shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    truth = composite(*field_along(field, voxel_grid, start, direction))
    samples, evidence = 1, [{"samples": 1, "error": _error(field, voxel_grid, start, direction, 1, seed, truth)}]
    while samples < MAX_SUPERSAMPLING:
        error = _error(field, voxel_grid, start, direction, 2 * samples, seed, truth)
        evidence.append({"samples": 2 * samples, "error": error})
        if error > (1 - MIN_GAIN) * evidence[-2]["error"]:
            break
        samples *= 2
    return samples, evidence


def _error(
    field: Field, voxel_grid: VoxelGrid, start: NDArray[Any], direction: NDArray[Any], samples: int, seed: int, truth: NDArray[Any]
) -> float:
    baked = composite(*baked_along(field, voxel_grid, start, direction, samples, seed))
    return round(float(np.sqrt(np.mean((baked - truth) ** 2))), 6)


def field_along(field: Field, voxel_grid: VoxelGrid, start: NDArray[Any], direction: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Premultiplied RGB [N, K, 3] and opacity [N, K] of the field along rays in voxel coordinates, FINER to a voxel."""
    along = (np.arange(TEST_RAY_VOXELS * REFERENCE_SAMPLES_PER_VOXEL) + 0.5) / REFERENCE_SAMPLES_PER_VOXEL
    points = start[:, None] + direction[:, None] * along[:, None]
    density, rgb, _ = field.query(voxel_grid.voxel_centres(points.reshape(-1, 3)))
    alpha = opacity(np, optical_depth(np, density, np.float32(voxel_grid.voxel_size / REFERENCE_SAMPLES_PER_VOXEL)))
    return (rgb * alpha[:, None]).reshape(*points.shape), alpha.reshape(points.shape[:2])


def baked_along(
    field: Field, voxel_grid: VoxelGrid, start: NDArray[Any], direction: NDArray[Any], samples: int, seed: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """The same from voxels baked with so many samples, interpolated as the marcher does, one to a voxel."""
    points = (start[:, None] + direction[:, None] * (np.arange(TEST_RAY_VOXELS) + 0.5)[:, None]).reshape(-1, 3)
    corner = np.floor(points).astype(np.int64)
    values: Any = 0.0
    for step in np.ndindex(2, 2, 2):
        there = corner + step
        weight = np.where(step, points - corner, 1 - (points - corner)).prod(axis=-1)
        colour, alpha = average_in_voxels(field, voxel_grid, np.maximum(there, 0), samples, seed)
        values = values + weight[:, None] * np.concatenate([colour[:, :3], alpha[:, None]], axis=-1)
    return values[:, :3].reshape(len(start), TEST_RAY_VOXELS, 3), values[:, 3].reshape(len(start), TEST_RAY_VOXELS)


def composite(colour: NDArray[Any], alpha: NDArray[Any]) -> NDArray[Any]:
    """Premultiplied RGB and transmittance [N, 4] of rays, front to back, from [N, K, 3] and [N, K] (eqs. 5, 6)."""
    through = np.cumprod(1 - alpha, axis=-1)
    before = np.concatenate([np.ones_like(through[:, :1]), through[:, :-1]], axis=-1)
    return np.concatenate([(before[..., None] * colour).sum(axis=1), through[:, -1:]], axis=-1)


def average_in_voxels(
    field: Field, voxel_grid: VoxelGrid, voxels: NDArray[Any], samples: int, seed: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Premultiplied RGB and features [N, C], and opacity [N], averaged over each voxel's own jitter, at voxel indices [N, 3].

    Offsets come in pairs of opposite signs, so that no voxel's content moves (hard case 48); an odd one is the centre.
    Opacity is averaged and colour premultiplied by it, as the reference does where the paper says density: half
    a voxel of solid matter then stops half the light, where the mean density would stop all of it (hard case 49).
    """
    offsets = voxel_normal(voxels, samples // 2, seed) / np.sqrt(12)
    signed: list[Any] = [sign * offsets[:, pair] for pair in range(samples // 2) for sign in (1, -1)]
    if samples % 2:
        signed.append(0.0)
    colour: Any = 0.0
    total = np.zeros(len(voxels), np.float32)
    for offset in signed:
        density, rgb, features = field.query(voxel_grid.voxel_centres(voxels + offset))
        alpha = opacity(np, optical_depth(np, density, np.float32(voxel_grid.voxel_size)))
        colour = colour + np.concatenate([rgb, features], axis=-1) * alpha[:, None]
        total += alpha
    return colour / np.float32(samples), total / np.float32(samples)
