"""The baked scene (section 5.1): indirection grid, atlas cells, view-dependence network."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import rigid
from ..geometry.ndc import Ndc
from ..nerf.model import SHAPES, ViewNetwork
from .blocks import CELL_VOXELS, DATA_VOXELS


@dataclass(frozen=True, eq=False)
class Scene:
    """A Sparse Neural Radiance Grid.

    ndc: the grid's world is the world where None; else it is the world in these device coordinates, whose units lengths
        of the grid then have. Cameras, near and depth stay in the world.
    grid_to_world: [4, 4] float64 rigid; grid coordinates are world units along the box's axes, from the
        outer corner of voxel (0, 0, 0). Voxel i has its centre at (i + 0.5) * voxel_size.
    voxel_size: world units. shape: voxels (x, y, z).
    indirection: int32 [bx, by, bz], b = ceil(shape / 30): a cell's number, or -1 where the block is empty.
    cells: uint8, or float32 in [0, 1] where it is not quantised, [M, 32, 32, 32, C], x, y, z with z fastest: 30 voxels of the
        block's own and an apron of one voxel of its neighbours on each side. C = 8: RGB, 4 features, alpha, all premultiplied by alpha;
        C = 4 in a diffuse scene: RGB, alpha. Alpha is the opacity of a step of one voxel.
    network: the view-dependence network, or None in a diffuse scene.
    view_rotation: [3, 3] from world directions to the axes in which the network was trained.
    opacity_correction: whether what a ray gathers is made up to 1.5 times as opaque (eq. 9), as the paper does in forward-facing scenes.
    near: distance along a ray, world units, before which nothing is seen.
    about: where the scene came from and what its bake measured; JSON values.
    """

    grid_to_world: NDArray[Any]
    voxel_size: float
    shape: tuple[int, int, int]
    indirection: NDArray[Any]
    cells: NDArray[Any]
    network: ViewNetwork | None
    view_rotation: NDArray[Any] = field(default_factory=lambda: np.eye(3))
    near: float = 0.0
    about: dict[str, Any] = field(default_factory=dict)
    ndc: Ndc | None = None
    opacity_correction: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "grid_to_world", rigid(self.grid_to_world, "The scene's grid"))
        if not (np.isfinite(self.voxel_size) and self.voxel_size > 0):
            raise SnergError(f"The scene has voxels of size {self.voxel_size}; bake it again.")
        if self.indirection.shape != blocks_of(self.shape):
            raise SnergError(f"The scene's indirection grid is {self.indirection.shape}, not {blocks_of(self.shape)}; bake it again.")
        channels = 4 if self.network is None else 8
        if self.cells.shape[1:] != (CELL_VOXELS,) * 3 + (channels,) or self.cells.dtype not in (np.uint8, np.float32):
            raise SnergError(f"The scene's atlas cells are {self.cells.shape} {self.cells.dtype}; bake it again.")
        if self.indirection.size and not -1 <= self.indirection.min() <= self.indirection.max() < max(len(self.cells), 1):
            raise SnergError("The scene's indirection grid points outside its atlas; bake it again.")
        if self.network is not None:
            for name, array, shape in zip(ViewNetwork._fields, self.network, SHAPES, strict=True):
                if np.shape(array) != shape or not np.isfinite(array).all():
                    raise SnergError(f"The scene's network has a bad {name}: it must be {shape} and finite; bake it again.")

    @property
    def box(self) -> Box:
        """The volume of the whole lattice as a box in the grid's world (see `ndc`)."""
        size = np.array(self.shape) * self.voxel_size
        pose = self.grid_to_world.copy()
        pose[:3, 3] += pose[:3, :3] @ (size / 2)
        return Box(pose, size)

    @property
    def quantised(self) -> bool:
        """Whether cells hold 8 bits a value, and not floats as they are only to compare with (table 1)."""
        return self.cells.dtype == np.uint8

    @property
    def unit(self) -> float:
        """What cells hold where a value is 1."""
        return 255.0 if self.quantised else 1.0

    @property
    def effects(self) -> dict[str, bool]:
        """Which optional effects the scene carries."""
        return {"view_dependence": self.network is not None, "ndc": self.ndc is not None, "fill_holes": self.opacity_correction}


def blocks_of(shape: tuple[int, int, int]) -> tuple[int, int, int]:
    """Macroblocks along each axis: ceil(voxels / 30) (hard case 46)."""
    x, y, z = (-(-n // DATA_VOXELS) for n in shape)
    return x, y, z
