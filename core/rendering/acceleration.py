"""The acceleration structure of a scene: packed voxels, and distances to the nearest occupied brick and stencil."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ..scene.blocks import CELL_VOXELS, DATA_VOXELS
from ..scene.scene import Scene

BRICK_VOXELS = 6  # side of a brick, the unit of empty-space skipping; 5 bricks fill a block's own 30 voxels
BRICKS_PER_BLOCK = DATA_VOXELS // BRICK_VOXELS
MAX_VOXEL_SKIP = 6  # voxels that one jump inside a brick can pass: a brick's side
MAX_BRICK_DISTANCE = 255  # of uint8
STRIDES = (CELL_VOXELS**2, CELL_VOXELS, 1)  # index differences between voxels that are neighbours along x, y, z
ALL_BITS = 0xFFFFFFFF


@dataclass(frozen=True, eq=False)
class Acceleration:
    """What the marcher reads of a scene.

    A trilinear stencil is the cube between the centres of 8 neighbouring voxels; stencil (i, j, k) has its lowest corner, its `base`, in
    voxel (i, j, k) of a cell. It is occupied when one of its 8 voxels is not 0: only then can a sample in it be anything but 0.

    voxels: a voxel as one word of C bytes, [M * 32^3] uint32 or uint64; float scenes: [M * 32^3, C] float32. squared: whether these
        are square roots. unit: see Scene.unit.
    brick_base: int64 [bricks], index in `voxels` that voxel (0, 0, 0) of the whole grid would have if all of it lay in the brick's cell;
        arbitrary where the brick's block has no cell.
    brick_distance: uint8 [bricks], Chebyshev distance in bricks to the nearest brick with an occupied stencil; 0 in those.
    bricks: bricks along x, y, z (z fastest), one more than the blocks have: it repeats the last brick, because rounding may place a sample
        on the grid's outer face.
    voxel_skip: uint8 [M * 32^3], Chebyshev distance in voxels to the nearest occupied stencil of the cell, at most MAX_VOXEL_SKIP and at
        most the distance to a stencil that the cell shares with a neighbour; 0 in occupied stencils.
    """

    voxels: NDArray[Any]
    channels: int
    unit: float
    squared: bool
    brick_base: NDArray[Any]
    brick_distance: NDArray[Any]
    bricks: tuple[int, int, int]
    voxel_skip: NDArray[Any]


_cache: WeakKeyDictionary[Scene, Acceleration] = WeakKeyDictionary()


def acceleration_of(scene: Scene) -> Acceleration:
    """The acceleration structure of a scene, built on first use and kept as long as the scene."""
    acceleration = _cache.get(scene)
    if acceleration is None:
        acceleration = _cache[scene] = build_acceleration(scene)
    return acceleration


def build_acceleration(scene: Scene) -> Acceleration:
    """Compute the acceleration structure of a scene from its cells; `acceleration_of` keeps it, so call that one.

    The result holds the voxels without a copy, plus 1 byte a voxel of the atlas and 9 bytes a brick of the grid.
    """
    cells = scene.cells if len(scene.cells) else np.zeros((1, *scene.cells.shape[1:]), scene.cells.dtype)
    channels, flat = cells.shape[-1], np.ascontiguousarray(cells).reshape(-1, cells.shape[-1])
    voxels = flat.view(np.uint64 if channels == 8 else np.uint32).reshape(-1) if scene.quantised else flat
    occupied_voxels = voxels != 0 if scene.quantised else (voxels != 0).any(axis=-1)
    stencils = occupied_stencils(occupied_voxels.reshape(-1, CELL_VOXELS, CELL_VOXELS, CELL_VOXELS))
    occupied, base = _bricks(scene.indirection, stencils)
    x, y, z = occupied.shape
    return Acceleration(
        voxels=voxels,
        channels=channels,
        unit=scene.unit,
        squared=scene.square_roots,
        brick_base=base.reshape(-1),
        brick_distance=chebyshev_distance(occupied, MAX_BRICK_DISTANCE).reshape(-1),
        bricks=(x, y, z),
        voxel_skip=_voxel_skip(stencils),
    )


def occupied_stencils(occupied: NDArray[Any]) -> NDArray[Any]:
    """Occupied voxels, bool [M, 32, 32, 32], to occupied stencils, uint32 [M, 32, 32] with stencil z in bit z.

    Stencils whose base is voxel 31 reach outside the cell; only their voxels inside count. No sample lies in them.
    """
    bits = np.packbits(occupied, axis=-1, bitorder="little").view("<u4")[..., 0].astype(np.uint32)
    bits |= bits >> np.uint32(1)
    bits[:, :, :-1] |= bits[:, :, 1:]
    bits[:, :-1] |= bits[:, 1:]
    return bits


def _bricks(indirection: NDArray[Any], stencils: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Which bricks are occupied, bool [bricks x, y, z], and their `brick_base` (see Acceleration), of the same shape.

    Samples in brick i of a cell lie in the stencils 6 i to 6 i + 6, both included.
    """
    masks = np.array([((1 << (BRICK_VOXELS + 1)) - 1) << (BRICK_VOXELS * i) for i in range(BRICKS_PER_BLOCK)], np.uint32)
    found = (stencils[..., None] & masks) != 0  # [M, 32, 32, 5]
    for axis in (1, 2):
        parts = [slice(BRICK_VOXELS * i, BRICK_VOXELS * i + BRICK_VOXELS + 1) for i in range(BRICKS_PER_BLOCK)]
        found = np.stack([found[(slice(None),) * axis + (part,)].any(axis=axis) for part in parts], axis=axis)
    shape = indirection.shape
    occupied = np.zeros((*shape, BRICKS_PER_BLOCK, BRICKS_PER_BLOCK, BRICKS_PER_BLOCK), bool)
    has_cell = indirection >= 0
    occupied[has_cell] = found[indirection[has_cell]]
    occupied = occupied.transpose(0, 3, 1, 4, 2, 5).reshape(*(n * BRICKS_PER_BLOCK for n in shape))
    corner = np.tensordot(np.indices(shape), np.array(STRIDES) * DATA_VOXELS, axes=(0, 0))
    base = np.maximum(indirection, 0).astype(np.int64) * CELL_VOXELS**3 - corner
    for axis in range(3):
        base = base.repeat(BRICKS_PER_BLOCK, axis=axis)
    return np.pad(occupied, (0, 1), mode="edge"), np.pad(base, (0, 1), mode="edge")


def _voxel_skip(stencils: NDArray[Any]) -> NDArray[Any]:
    """Acceleration.voxel_skip of occupied stencils uint32 [M, 32, 32]: how many dilations it takes to reach each stencil."""
    skip = np.zeros((len(stencils), CELL_VOXELS, CELL_VOXELS, CELL_VOXELS), np.uint8)
    reached = stencils.copy()
    for distance in range(MAX_VOXEL_SKIP):
        if distance:
            reached = _dilate_stencils(reached, distance)
        empty = np.unpackbits((~reached).astype("<u4").view(np.uint8).reshape(len(stencils), CELL_VOXELS, -1), axis=-1, bitorder="little")
        skip += empty.reshape(skip.shape)
    return skip.reshape(-1)


def _dilate_stencils(bits: NDArray[Any], distance: int) -> NDArray[Any]:
    """Dilate stencils uint32 [M, 32, 32] by one in the maximum norm; the `distance`-th dilation.

    A neighbouring block may hold anything in the stencils that it shares with this one, 0 and 30 along an axis. They count as occupied
    from the first dilation on, so that all stencils within `distance` of them count as reached.
    """
    bits = bits | (bits << np.uint32(1)) | (bits >> np.uint32(1))
    wide = bits.copy()
    wide[:, :, 1:] |= bits[:, :, :-1]
    wide[:, :, :-1] |= bits[:, :, 1:]
    bits = wide.copy()
    bits[:, 1:] |= wide[:, :-1]
    bits[:, :-1] |= wide[:, 1:]
    low, high = distance, DATA_VOXELS - distance
    bits |= np.uint32((1 << low + 1) - 1 | (ALL_BITS << high) & ALL_BITS)
    bits[:, :, : low + 1] = bits[:, :, high:] = ALL_BITS
    bits[:, : low + 1] = bits[:, high:] = ALL_BITS
    return bits


def chebyshev_distance(occupied: NDArray[Any], limit: int, axes: Sequence[int] | None = None) -> NDArray[Any]:
    """Distance of each element to the nearest True in the maximum norm, at most `limit` and 255: uint8 of a bool array of the same shape.

    axes: along which to measure, all when None: elements that differ along another axis, such as cells [M, ...], are not neighbours.
    """
    if not occupied.any():
        return np.full(occupied.shape, min(limit, 255), np.uint8)
    distance = np.where(occupied, 0, 1).astype(np.uint8)
    reached = occupied.copy()
    for _ in range(1, min(limit, 255)):
        if reached.all():
            break
        for axis in range(reached.ndim) if axes is None else axes:
            reached = dilate_axis(reached, axis)
        distance += ~reached
    return distance


def dilate_axis(mask: NDArray[Any], axis: int) -> NDArray[Any]:
    """A bool mask of any shape dilated by one element along an axis."""
    wide = mask.copy()
    after, before = [slice(None)] * mask.ndim, [slice(None)] * mask.ndim
    after[axis], before[axis] = slice(1, None), slice(None, -1)
    wide[tuple(before)] |= mask[tuple(after)]
    wide[tuple(after)] |= mask[tuple(before)]
    return wide
