"""The box that the content of a field takes up: the occupied cells of its occupancy grid, without stray groups far from the rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from .field import Field
from .sampling import CELLS

GROUP_CELLS = 4  # cells along an axis: occupied cells closer than this belong to one group
STRAY_SHARE = 1e-3  # of the occupied cells; a group of fewer is stray: a floater that training left behind


@dataclass(frozen=True, eq=False)
class Content:
    """box: of the content. cells: occupied cells in it. stray: occupied cells of the groups that were left out. groups: their number."""

    box: Box
    cells: int
    stray: int
    groups: int


def content_of(field: Field, axes: NDArray[np.float64] | None = None) -> Content:
    """The smallest box that holds what a field contains, in world units.

    axes: the box's axes as the columns of a rotation [3, 3]; the world's by default. Raises SnergError for a field without an occupancy
    grid, a field that is empty, and a forward-facing field, whose space is not the world.
    """
    if field.ndc is not None:
        raise SnergError("The field is of a forward-facing capture, which is baked whole; it needs no box.")
    if field.occupancy is None:
        raise SnergError("The field has no occupancy grid, as an imported checkpoint; fit the box by its arrows.")
    if not field.occupancy.any():
        raise SnergError("The field holds nothing; train it longer.")
    groups = groups_of(field.occupancy.reshape((CELLS,) * 3))
    sizes = np.bincount(groups.ravel())[1:]
    kept = np.flatnonzero(sizes >= STRAY_SHARE * sizes.sum()) + 1
    held = np.isin(groups, kept)
    rotation = np.eye(3) if axes is None else np.asarray(axes, np.float64)
    centres = field.domain.to_world((np.argwhere(held) + 0.5) * (2 / CELLS) - 1) @ rotation
    half = np.abs(rotation).sum(axis=0) / (CELLS * field.domain.scale)  # of a cell, along the box's axes
    low, high = centres.min(axis=0) - half, centres.max(axis=0) + half
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, rotation @ ((low + high) / 2)
    stray = int(sizes.sum()) - len(centres)
    return Content(Box(pose, high - low), len(centres), stray, len(sizes) - len(kept))


def groups_of(occupied: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The group of each cell, int32 [N, N, N] from 1 on, 0 where it is not occupied: connected cubes of GROUP_CELLS^3 cells."""
    count = len(occupied) // GROUP_CELLS
    coarse = occupied.reshape((count, GROUP_CELLS) * 3).any(axis=(1, 3, 5))
    labels = np.zeros(coarse.shape, np.int32)
    while (left := np.flatnonzero(coarse & (labels == 0))).size:
        group = np.zeros_like(coarse)
        group.flat[left[0]] = True
        while (grown := neighbours(group) & coarse).sum() > group.sum():
            group = grown
        labels[group] = labels.max() + 1
    fine = labels.repeat(GROUP_CELLS, 0).repeat(GROUP_CELLS, 1).repeat(GROUP_CELLS, 2)
    return np.asarray(np.where(occupied, fine, 0).astype(np.int32))


def neighbours(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The cells and their 26 neighbours, bool [N, N, N]."""
    for axis in range(3):
        padded = np.pad(cells, [(1, 1) if axis == other else (0, 0) for other in range(3)])
        cells = np.logical_or.reduce([np.take(padded, range(start, start + cells.shape[axis]), axis=axis) for start in range(3)])
    return cells
