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
    """A Sparse Neural Radiance Grid (SNeRG). Raises SnergError when its parts do not fit together.

    grid_to_world: [4, 4] float64, rigid. Grid coordinates have the world's units and start at the outer corner of voxel (0, 0, 0); the
        centre of voxel i is at (i + 0.5) * voxel_size.
    voxel_size: side of a voxel, world units. shape: voxels (x, y, z).
    indirection: int32 [bx, by, bz] with b = ceil(shape / 30): number of each block's atlas cell, or -1 for an empty block.
    cells: [M, 32, 32, 32, C], z fastest: a block's own 30 voxels along each axis and an apron of one voxel of its neighbours on each
        side. uint8, or float32 in [0, 1] in an unquantised scene. C = 8: RGB, 4 features, alpha; C = 4 in a diffuse scene: RGB, alpha.
        RGB and features are premultiplied by alpha, the opacity along one voxel's length.
    square_roots: whether cells, then uint8, hold the square roots of their values: in thin fog (see quantize.py).
    network: the view-dependence network, or None in a diffuse scene.
    view_rotation: [3, 3] rotation from world directions to the axes in which the network was trained.
    near: world units along a ray, before which the scene is invisible.
    about: provenance and measurements of the bake; JSON values.
    ndc: None, or the normalised device coordinates in which the grid lies (forward-facing scenes). "World" above then means that space,
        and the grid's lengths have its units; cameras, near and depth stay in the real world.
    opacity_correction: whether composited rays are corrected by eq. 9, as the paper does in forward-facing scenes.
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
    square_roots: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "grid_to_world", rigid(self.grid_to_world, "The scene's grid"))
        if not (np.isfinite(self.voxel_size) and self.voxel_size > 0):
            raise SnergError(f"The scene has voxels of size {self.voxel_size}; bake it again.")
        if self.indirection.shape != blocks_of(self.shape):
            raise SnergError(f"The scene's indirection grid is {self.indirection.shape}, not {blocks_of(self.shape)}; bake it again.")
        channels = 4 if self.network is None else 8
        if self.cells.shape[1:] != (CELL_VOXELS,) * 3 + (channels,) or self.cells.dtype not in (np.uint8, np.float32):
            raise SnergError(f"The scene's atlas cells are {self.cells.shape} {self.cells.dtype}; bake it again.")
        if self.square_roots and not self.quantised:
            raise SnergError("The scene says that its cells hold square roots, and they hold floats; bake it again.")
        if self.indirection.size and not -1 <= self.indirection.min() <= self.indirection.max() < max(len(self.cells), 1):
            raise SnergError("The scene's indirection grid points outside its atlas; bake it again.")
        if self.network is not None:
            for name, array, shape in zip(ViewNetwork._fields, self.network, SHAPES, strict=True):
                if np.shape(array) != shape or not np.isfinite(array).all():
                    raise SnergError(f"The scene's network has a bad {name}: it must be {shape} and finite; bake it again.")

    @property
    def box(self) -> Box:
        """The volume of all voxels as a box in the grid's world (see `ndc`)."""
        size = np.array(self.shape) * self.voxel_size
        pose = self.grid_to_world.copy()
        pose[:3, 3] += pose[:3, :3] @ (size / 2)
        return Box(pose, size)

    @property
    def quantised(self) -> bool:
        """Whether cells are uint8; float32 cells exist only to measure what quantisation costs (table 1)."""
        return self.cells.dtype == np.uint8

    @property
    def unit(self) -> float:
        """What `linear` makes of a stored 1.0: 255 in quantised cells, 255^2 of square roots, else 1."""
        return 255.0 ** (1 + self.square_roots) if self.quantised else 1.0

    def linear(self, stored: NDArray[Any]) -> NDArray[Any]:
        """Stored values as numbers in proportion to what they mean, elementwise, `unit` times as large: the squares, uint16, of roots."""
        return np.square(stored, dtype=np.uint16) if self.square_roots else stored

    @property
    def effects(self) -> dict[str, bool]:
        """Which optional effects the scene uses, by the names that scene.json has for them; "thin_fog" is there only in its scenes."""
        fog = {"thin_fog": True} if self.square_roots else {}
        return {"view_dependence": self.network is not None, "ndc": self.ndc is not None, "fill_holes": self.opacity_correction, **fog}


def blocks_of(shape: tuple[int, int, int]) -> tuple[int, int, int]:
    """Macroblocks along each axis: ceil(voxels / 30), so that a partly filled last block is kept (hard case 46)."""
    x, y, z = (-(-n // DATA_VOXELS) for n in shape)
    return x, y, z
