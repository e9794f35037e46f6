"""The lattice of voxels inside a box."""

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

MAX_RESOLUTION = 4096  # voxels along an axis that a bake may have


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Voxels inside a box, and one more on each side so that what lies on a face keeps its tent (hard case 36).

    grid_to_world, voxel_size, shape: as in Scene.
    """

    grid_to_world: NDArray[Any]
    voxel_size: float
    shape: tuple[int, int, int]

    @classmethod
    def inside(cls, box: Box, voxel: float) -> VoxelGrid:
        """Voxels of a size in units of the box. Raises SnergError when there would be too many along a side."""
        counts = np.ceil(box.size / voxel - 1e-6)
        if counts.max() > MAX_RESOLUTION:
            most = float(box.size.max()) / MAX_RESOLUTION
            raise SnergError(f"Voxels of {voxel:.3g} make {counts.max():.0f} along the box's longest side; choose at least {most:.3g}.")
        counts = counts.astype(int).clip(1) + 2
        pose = box.box_to_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ (counts * voxel / 2)
        x, y, z = (int(n) for n in counts)
        return cls(pose, voxel, (x, y, z))

    @property
    def blocks(self) -> tuple[int, int, int]:
        """Macroblocks along each axis."""
        return blocks_of(self.shape)

    def halved(self) -> VoxelGrid:
        """Voxels twice as large from the same corner, as many as it takes to cover these."""
        x, y, z = (-(-n // 2) for n in self.shape)
        return VoxelGrid(self.grid_to_world, 2 * self.voxel_size, (x, y, z))

    def points(self, voxels: NDArray[Any]) -> NDArray[Any]:
        """Centres [N, 3] float64 of voxels given by (possibly fractional) index [N, 3]."""
        local = (voxels + 0.5) * self.voxel_size
        return local @ self.grid_to_world[:3, :3].T + self.grid_to_world[:3, 3]

    @cached_property
    def _of_first_block(self) -> NDArray[Any]:
        return self.points(np.indices((DATA_VOXELS,) * 3).reshape(3, -1).T) - self.grid_to_world[:3, 3]

    def centres(self, places: NDArray[Any]) -> NDArray[Any]:
        """Centres [B * 27000, 3] float64 of the voxels of blocks at places [B, 3], z fastest."""
        corners = self.points(places * DATA_VOXELS - 0.5)
        return (corners[:, None] + self._of_first_block).reshape(-1, 3)

    def clear_outside(self, values: NDArray[Any], places: NDArray[Any]) -> None:
        """Set to 0, in blocks [B, 30, 30, 30, ...] at places [B, 3], what lies past the lattice's last voxel."""
        left = np.array(self.shape) - places * DATA_VOXELS
        for row in np.flatnonzero((left < DATA_VOXELS).any(axis=-1)):
            for axis in range(3):
                values[(row, *(slice(None),) * axis, slice(int(left[row, axis]), None))] = 0
