"""Random numbers that are a function of the voxel: the same whatever is culled and in whatever order voxels are baked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Constants of splitmix64 (Steele, Lea and Flood 2014): the increment, and the multipliers of its mixing function. STREAM is another odd
# constant, which separates the numbers of one voxel.
GOLDEN, MIX_1, MIX_2 = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
STREAM = 0xD1B54A32D192ED03


def voxel_uniform(voxels: NDArray[Any], count: int, seed: int) -> NDArray[Any]:
    """`count` uniform numbers in [0, 1) for each voxel, float32 [N, count]. voxels: indices [N, 3], 0 to 2^21 - 1."""
    index = voxels.astype(np.uint64)
    key = (index[:, 0] << np.uint64(42)) ^ (index[:, 1] << np.uint64(21)) ^ index[:, 2]
    key = _mix(key + np.uint64((seed + 1) * GOLDEN % 2**64))
    steps = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(STREAM)
    uniform: NDArray[Any] = (_mix(key[:, None] + steps) >> np.uint64(40)).astype(np.float32) * np.float32(2**-24)
    return uniform


def voxel_normal(voxels: NDArray[Any], count: int, seed: int) -> NDArray[Any]:
    """`count` vectors of standard normal numbers for each voxel, float32 [N, count, 3] (Box and Muller 1958). voxels: [N, 3]."""
    u = voxel_uniform(voxels, 4 * count, seed).reshape(len(voxels), count, 4)
    radius = np.sqrt(-2 * np.log(1 - u[..., :2]))
    angle = np.float32(2 * np.pi) * u[..., 2:]
    normal: NDArray[Any] = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    return normal[..., :3]


def _mix(x: NDArray[Any]) -> NDArray[Any]:
    """The mixing function of splitmix64, elementwise on uint64."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(MIX_1)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(MIX_2)
    mixed: NDArray[Any] = x ^ (x >> np.uint64(31))
    return mixed
