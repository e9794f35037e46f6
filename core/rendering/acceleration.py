"""What the marcher looks up: voxels as words, where a block's cell begins, and how far the nearest thing is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ..scene.blocks import CELL_VOXELS, DATA_VOXELS
from ..scene.scene import Scene

BRICK_VOXELS = 6  # voxels along a brick, by which the way through empty space is measured; five of them make a block's own 30
BRICKS_PER_BLOCK = DATA_VOXELS // BRICK_VOXELS
MAX_VOXEL_SKIP = 6  # voxels that one jump inside a brick can pass
STRIDES = (CELL_VOXELS**2, CELL_VOXELS, 1)  # words from a voxel to its neighbours along x, y, z


@dataclass(frozen=True, eq=False)
class Acceleration:
    """What a march looks up. A tent is the reach of trilinear interpolation between 8 voxels; tent (i, j, k) has its lowest corner
    in voxel (i, j, k) of a cell.

    voxels: a word of C bytes a voxel [M * 32^3], or its C floats [M * 32^3, C]. unit: what a value of 1 is stored as.
    brick_base: int64, word of the voxel that (0, 0, 0) of the whole grid would be in a brick's cell, anything where there is none.
    brick_distance: uint8, Chebyshev distance in bricks to the nearest of whose tents one holds something, 0 in those.
    Bricks are numbered x, y, z, z fastest; `bricks` is how many along each axis, one more than the blocks have, which repeats
    the last: the outer face of the grid belongs to it, and rounding must not push a sample out of its block.
    voxel_skip: uint8 [M * 32^3] Chebyshev distance in voxels to the nearest tent that holds something within the cell, and at most
    that to the first tent that it shares with a neighbour; 0 where the tent itself holds something.
    """

    voxels: NDArray[Any]
    channels: int
    unit: float
    brick_base: NDArray[Any]
    brick_distance: NDArray[Any]
    bricks: tuple[int, int, int]
    voxel_skip: NDArray[Any]


_cache: WeakKeyDictionary[Scene, Acceleration] = WeakKeyDictionary()


def acceleration_of(scene: Scene) -> Acceleration:
    """The look-up tables of a scene, made once."""
    tables = _cache.get(scene)
    if tables is None:
        tables = _cache[scene] = build_acceleration(scene)
    return tables


def build_acceleration(scene: Scene) -> Acceleration:
    """See `Acceleration`."""
    cells = scene.cells if len(scene.cells) else np.zeros((1, *scene.cells.shape[1:]), scene.cells.dtype)
    channels, flat = cells.shape[-1], np.ascontiguousarray(cells).reshape(-1, cells.shape[-1])
    voxels = flat.view(np.uint64 if channels == 8 else np.uint32).reshape(-1) if scene.quantised else flat
    tents = occupied_stencils(
        (voxels != 0 if scene.quantised else (voxels != 0).any(axis=-1)).reshape(-1, CELL_VOXELS, CELL_VOXELS, CELL_VOXELS)
    )
    occupied, base = _bricks(scene.indirection, tents)
    x, y, z = occupied.shape
    return Acceleration(
        voxels=voxels,
        channels=channels,
        unit=scene.unit,
        brick_base=base.reshape(-1),
        brick_distance=chebyshev_distance(occupied, 255).reshape(-1),
        bricks=(x, y, z),
        voxel_skip=_voxel_skip(tents),
    )


def occupied_stencils(full: NDArray[Any]) -> NDArray[Any]:
    """bool voxels [M, 32, 32, 32] to tents that hold something, uint32 [M, 32, 32] with z in the bits (z = 0 the lowest).

    Tents past the cell's last voxel (index 31) are only as full as what of them is in the cell; no sample reaches them.
    """
    bits = np.packbits(full, axis=-1, bitorder="little").view("<u4")[..., 0].astype(np.uint32)
    bits |= bits >> np.uint32(1)
    bits[:, :, :-1] |= bits[:, :, 1:]
    bits[:, :-1] |= bits[:, 1:]
    return bits


def _bricks(indirection: NDArray[Any], tents: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Of each brick whether something is in the tents that a sample inside can touch, and its base (see `Acceleration`)."""
    masks = np.array([((1 << (BRICK_VOXELS + 1)) - 1) << (BRICK_VOXELS * i) for i in range(BRICKS_PER_BLOCK)], np.uint32)
    found = (tents[..., None] & masks) != 0  # along z already by bricks: samples of brick i touch tents 6 i to 6 i + 6
    for axis in (1, 2):
        parts = [slice(BRICK_VOXELS * i, BRICK_VOXELS * i + BRICK_VOXELS + 1) for i in range(BRICKS_PER_BLOCK)]
        found = np.stack([found[(slice(None),) * axis + (part,)].any(axis=axis) for part in parts], axis=axis)
    shape = indirection.shape
    occupied = np.zeros((*shape, BRICKS_PER_BLOCK, BRICKS_PER_BLOCK, BRICKS_PER_BLOCK), bool)
    full = indirection >= 0
    occupied[full] = found[indirection[full]]
    occupied = occupied.transpose(0, 3, 1, 4, 2, 5).reshape(*(n * BRICKS_PER_BLOCK for n in shape))
    corner = np.tensordot(np.indices(shape), np.array(STRIDES) * DATA_VOXELS, axes=(0, 0))
    base = np.maximum(indirection, 0).astype(np.int64) * CELL_VOXELS**3 - corner
    for axis in range(3):
        base = base.repeat(BRICKS_PER_BLOCK, axis=axis)
    return np.pad(occupied, (0, 1), mode="edge"), np.pad(base, (0, 1), mode="edge")


def _voxel_skip(tents: NDArray[Any]) -> NDArray[Any]:
    """See `Acceleration`; at least 1 where nothing is, at most MAX_SKIP."""
    skip = np.zeros((len(tents), CELL_VOXELS, CELL_VOXELS, CELL_VOXELS), np.uint8)
    reached = tents.copy()
    for distance in range(MAX_VOXEL_SKIP):
        if distance:
            reached = _dilate_stencils(reached, distance)
        empty = np.unpackbits((~reached).astype("<u4").view(np.uint8).reshape(len(tents), CELL_VOXELS, -1), axis=-1, bitorder="little")
        skip += empty.reshape(skip.shape)
    return skip.reshape(-1)


def _dilate_stencils(bits: NDArray[Any], distance: int) -> NDArray[Any]:
    """Tents [M, 32, 32] grown by one on each side, z in the bits. The block's neighbours may hold anything, and share its tents 0 and
    30, so that those count as reached, and all that are `distance` away from them."""
    bits = bits | (bits << np.uint32(1)) | (bits >> np.uint32(1))
    wide = bits.copy()
    wide[:, :, 1:] |= bits[:, :, :-1]
    wide[:, :, :-1] |= bits[:, :, 1:]
    bits = wide.copy()
    bits[:, 1:] |= wide[:, :-1]
    bits[:, :-1] |= wide[:, 1:]
    low, high = distance, DATA_VOXELS - distance  # up to where and from where the border has been reached
    bits |= np.uint32((1 << low + 1) - 1 | (0xFFFFFFFF << high) & 0xFFFFFFFF)
    bits[:, :, : low + 1] = bits[:, :, high:] = 0xFFFFFFFF
    bits[:, : low + 1] = bits[:, high:] = 0xFFFFFFFF
    return bits


def chebyshev_distance(occupied: NDArray[Any], most: int) -> NDArray[Any]:
    """Distance to the nearest True in the maximum norm, uint8, at most `most`."""
    if not occupied.any():
        return np.full(occupied.shape, min(most, 255), np.uint8)
    distance = np.where(occupied, 0, 1).astype(np.uint8)
    reached = occupied.copy()
    for _ in range(1, min(most, 255)):
        if reached.all():
            break
        for axis in range(reached.ndim):
            reached = _dilate_axis(reached, axis)
        distance += ~reached
    return distance


def _dilate_axis(mask: NDArray[Any], axis: int) -> NDArray[Any]:
    """True also where a neighbour along the axis is."""
    wide = mask.copy()
    ahead, back = [slice(None)] * mask.ndim, [slice(None)] * mask.ndim
    ahead[axis], back[axis] = slice(1, None), slice(None, -1)
    wide[tuple(back)] |= mask[tuple(ahead)]
    wide[tuple(ahead)] |= mask[tuple(back)]
    return wide
