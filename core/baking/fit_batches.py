"""The voxels that a fit moves, and the batches of rays of always the same shapes that it is given. NumPy alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..rendering.interpolator import CORNER_OFFSETS
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS, block_coordinates
from ..scene.quantize import quantize
from ..scene.scene import Scene
from .jitter import voxel_uniform
from .ray_samples import MAX_RAY_SAMPLES, RaySamples, corners_of, own_voxels

BATCH_SAMPLES = 12  # samples a ray for which a batch has room, on average
ROUND_VOXELS = 2**16  # to a multiple of which voxels are counted
MIN_ALPHA = 1e-3  # of a voxel, by which premultiplied values are divided


class Batch(NamedTuple):
    """Rays [R] and their samples [S].

    corners: int32 [S, 8], numbers of the voxels of each stencil. fraction: see RaySamples. ray, slot: int32 [S], the sample's ray, and its
    number on that ray. valid: float32 [S], 0 in samples that fill up the batch. view_directions, pixels: of the rays. used: float32 [R],
    0 in rays that fill up the batch.
    """

    corners: Any
    fraction: Any
    ray: Any
    slot: Any
    valid: Any
    view_directions: Any
    pixels: Any
    used: Any


@dataclass(frozen=True, eq=False)
class Voxels:
    """The voxels of a scene that a fit moves, numbered from 0. The last number, P - 1, stands for any other voxel, which counts as empty.

    P is a multiple of ROUND_VOXELS, so that scenes of about the same size share what is compiled; the numbers that are left are not used.
    rows: int64 [n] the voxels' indices in the atlas, own voxels of their blocks. numbers: int32 [M * 32^3], of each voxel of the atlas
    its number. stored: [P, C] their values in the scene; zeros from n on.
    """

    rows: NDArray[Any]
    numbers: NDArray[Any]
    stored: NDArray[Any]

    @classmethod
    def of(cls, scene: Scene, samples: RaySamples) -> Voxels:
        """Those that are not 0 and that a sample lies next to."""
        own, cells = own_voxels(scene), scene.cells.reshape(-1, scene.cells.shape[-1])
        touched = np.zeros(len(own) + 1, bool)  # the last for NO_VOXEL, which is -1
        for offset in CORNER_OFFSETS:
            touched[own[samples.base + offset]] = True
        rows = np.flatnonzero(touched[:-1] & (cells[:, -1] > 0))
        stored = np.zeros((-(-(len(rows) + 1) // ROUND_VOXELS) * ROUND_VOXELS, cells.shape[1]), cells.dtype)
        stored[: len(rows)] = cells[rows]
        numbers = np.full(len(own) + 1, len(stored) - 1, np.int32)
        numbers[rows] = np.arange(len(rows), dtype=np.int32)
        return cls(rows, numbers[own], stored)

    def straight(self, unit: float) -> NDArray[Any]:
        """The stored values, float32 [P, C] in [0, 1], colour and features divided by alpha. unit: stored value of 1."""
        values = self.stored.astype(np.float32) / np.float32(unit)
        alpha = values[:, -1:]
        return np.concatenate([np.minimum(values[:, :-1] / np.maximum(alpha, MIN_ALPHA), 1), alpha], axis=-1)

    def to_store(self, scene: Scene, premultiplied: NDArray[Any], seed: int) -> NDArray[Any]:
        """Values [P, C] in [0, 1] as the scene stores them. seed: of the dither of thin voxels (see `quantize`)."""
        if not scene.quantised:
            return premultiplied
        cell, local = np.divmod(self.rows, CELL_VOXELS**3)
        inside = np.stack(np.unravel_index(local, (CELL_VOXELS,) * 3), axis=-1) - 1
        noise = voxel_uniform(block_coordinates(scene.indirection)[cell] * DATA_VOXELS + inside, premultiplied.shape[1], seed + 1)
        return np.concatenate([quantize(premultiplied[: len(self.rows)], noise), self.stored[len(self.rows) :]])


class Neighbourhoods:
    """Finds the voxels that occur in a batch: a step on these alone takes a tenth of the time of one on all. count: P."""

    def __init__(self, count: int) -> None:
        self.seen, self.place = np.zeros(count, bool), np.zeros(count, np.int32)

    def __call__(self, corners: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """The numbers of the voxels in corners [S, 8], int32 [8 S + 1], and the place of each corner among them, int32 [S, 8].

        They ascend; the empty voxel, P - 1, follows them and fills the rest.
        """
        self.seen[corners] = True
        self.seen[-1] = False
        rows = np.flatnonzero(self.seen)
        self.seen[rows] = False
        self.place[rows] = np.arange(len(rows), dtype=np.int32)
        self.place[-1] = len(rows)
        return _filled_up(rows.astype(np.int32), corners.size + 1, len(self.seen) - 1), self.place[corners]


def batch_ends(samples: RaySamples, order: NDArray[Any], size: int) -> Iterator[tuple[int, int]]:
    """(first, end) of each batch among rays in an order [n]: as many as have room in it, at most size - 1.

    The last ray and the last slot of a batch are never used: the samples that fill it up point there.
    """
    ends = np.cumsum(samples.first[order + 1] - samples.first[order])
    first = 0
    while first < len(order):
        before = int(ends[first - 1]) if first else 0
        end = min(int(np.searchsorted(ends, before + size * BATCH_SAMPLES, side="right")), first + size - 1)
        yield first, end
        first = end


def batches(samples: RaySamples, order: NDArray[Any], size: int, voxels: Voxels) -> Iterator[Batch]:
    """The batches of rays in an order [n], each of `size` rays and BATCH_SAMPLES times as many samples."""
    for first, end in batch_ends(samples, order, size):
        rays = order[first:end]
        rows, ray, slot = samples.rows(rays)
        corners = voxels.numbers[corners_of(samples.base[rows])]
        of_samples = (corners, samples.fraction[rows], ray.astype(np.int32), slot.astype(np.int32), np.ones(len(rows), np.float32))
        of_rays = (samples.view_directions[rays], samples.pixels[rays], np.ones(len(rays), np.float32))
        rest = (len(voxels.stored) - 1, 0, size - 1, MAX_RAY_SAMPLES - 1, 0)
        filled = [_filled_up(values, size * BATCH_SAMPLES, value) for values, value in zip(of_samples, rest, strict=True)]
        yield Batch(*filled, *(_filled_up(values, size, 0) for values in of_rays))


def _filled_up(values: NDArray[Any], size: int, value: int) -> NDArray[Any]:
    """Values [n, ...] followed by `value`, [size, ...]."""
    result = np.full((size, *values.shape[1:]), value, values.dtype)
    result[: len(values)] = values
    return result
