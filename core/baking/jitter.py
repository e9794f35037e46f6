"""Random numbers that belong to a voxel: the same whatever is culled, in whatever order voxels are baked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def voxel_uniform(voxels: NDArray[Any], count: int, seed: int) -> NDArray[Any]:
    """[N, count] float32 in [0, 1) for voxel indices [N, 3] (splitmix64 of index, seed and which number it is)."""
    index = voxels.astype(np.uint64)
    key = (index[:, 0] << np.uint64(42)) ^ (index[:, 1] << np.uint64(21)) ^ index[:, 2]
    key = _mix(key + np.uint64((seed + 1) * 0x9E3779B97F4A7C15 % 2**64))
    steps = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0xD1B54A32D192ED03)
    return (_mix(key[:, None] + steps) >> np.uint64(40)).astype(np.float32) * np.float32(2**-24)


def voxel_normal(voxels: NDArray[Any], pairs: int, seed: int) -> NDArray[Any]:
    """[N, pairs, 3] float32, normal with mean 0 and variance 1 (Box and Muller 1958)."""
    u = voxel_uniform(voxels, 4 * pairs, seed).reshape(len(voxels), pairs, 4)
    radius = np.sqrt(-2 * np.log(1 - u[..., :2]))
    angle = np.float32(2 * np.pi) * u[..., 2:]
    both = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    return both[..., :3]


def _mix(x: NDArray[Any]) -> NDArray[Any]:
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
