"""The voxel grid that covers a box: its pose, the size of a voxel and how many there are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from .blocks import DATA_VOXELS
from .scene import blocks_of

MAX_RESOLUTION = 4096  # voxels along an axis that a bake may have; coordinates stay exact to a thousandth of a voxel (hard case 50)
ROUNDING = 1e-6  # voxels by which a box may exceed a whole number of voxels without one more: rounding of its size


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Voxels that cover a box, and one more on each side: a surface on the box's face then keeps its whole stencil (hard case 36)."""

    grid_to_world: NDArray[Any]  # [4, 4] float64, rigid, as in Scene
    voxel_size: float  # world units
    shape: tuple[int, int, int]  # voxels along x, y, z

    @classmethod
    def inside(cls, box: Box, voxel_size: float) -> VoxelGrid:
        """The grid of a box with voxels of this size, in the box's units. Raises SnergError for more than MAX_RESOLUTION along a side."""
        counts = np.ceil(box.size / voxel_size - ROUNDING)
        if counts.max() > MAX_RESOLUTION:
            least = float(box.size.max()) / MAX_RESOLUTION
            raise SnergError(
                f"Voxels of {voxel_size:.3g} make {counts.max():.0f} along the box's longest side; choose at least {least:.3g}."
            )
        counts = counts.astype(int).clip(1) + 2
        pose = box.box_to_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ (counts * voxel_size / 2)
        x, y, z = (int(n) for n in counts)
        return cls(pose, voxel_size, (x, y, z))

    @property
    def blocks(self) -> tuple[int, int, int]:
        """Macroblocks along each axis."""
        return blocks_of(self.shape)

    def halved(self) -> VoxelGrid:
        """The grid of half the resolution from the same corner: voxels twice as large, as many as cover this grid."""
        x, y, z = (-(-n // 2) for n in self.shape)
        return VoxelGrid(self.grid_to_world, 2 * self.voxel_size, (x, y, z))

    def box_of(self, low: NDArray[Any], high: NDArray[Any]) -> Box:
        """The box from the outer corner of the voxel `low` [3] to that of `high` [3], which may lie outside of the grid."""
        pose = self.grid_to_world.copy()
        pose[:3, 3] += pose[:3, :3] @ ((low + high) / 2 * self.voxel_size)
        return Box(pose, (high - low) * self.voxel_size)

    def voxel_centres(self, voxels: NDArray[Any]) -> NDArray[Any]:
        """World positions [N, 3] float64 of the centres of voxels with these indices [N, 3], which may be fractional."""
        local = (voxels + 0.5) * self.voxel_size
        centres: NDArray[Any] = local @ self.grid_to_world[:3, :3].T + self.grid_to_world[:3, 3]
        return centres

    @cached_property
    def _first_block_offsets(self) -> NDArray[Any]:
        """[27000, 3] float64 from the grid's corner to the voxel centres of block (0, 0, 0), z fastest."""
        indices = np.indices((DATA_VOXELS,) * 3).reshape(3, -1).T
        return np.asarray(self.voxel_centres(indices) - self.grid_to_world[:3, 3])

    def block_centres(self, coordinates: NDArray[Any]) -> NDArray[Any]:
        """World positions [B * 27000, 3] float64 of the voxel centres of blocks at coordinates [B, 3], z fastest."""
        corners = self.voxel_centres(coordinates * DATA_VOXELS - 0.5)
        return np.asarray((corners[:, None] + self._first_block_offsets).reshape(-1, 3))

    def zero_outside(self, values: NDArray[Any], coordinates: NDArray[Any]) -> None:
        """Set voxels past the grid's last one to 0, in place. values: [B, 30, 30, 30, ...] of blocks at coordinates [B, 3]."""
        inside = np.array(self.shape) - coordinates * DATA_VOXELS
        for row in np.flatnonzero((inside < DATA_VOXELS).any(axis=-1)):
            for axis in range(3):
                values[(row, *(slice(None),) * axis, slice(int(inside[row, axis]), None))] = 0
