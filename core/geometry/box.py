"""The oriented box that is trained or baked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.json_files import read_json
from .camera import rigid

MAX_SHEAR = 1e-4  # largest cosine between two sides of a box; rounding in Blender's float32 matrices gives less


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented box. Raises SnergError when a side is not finite and above 0, or the pose is invalid."""

    box_to_world: NDArray[Any]  # [4, 4] float64, rigid, origin at the box's centre
    size: NDArray[Any]  # [3] float64, world units

    def __post_init__(self) -> None:
        object.__setattr__(self, "box_to_world", rigid(self.box_to_world, "The box"))
        size = np.array(self.size, dtype=np.float64).reshape(-1)
        if size.shape != (3,) or not np.isfinite(size).all() or not (size > 0).all():
            raise SnergError(f"The box has sides of {size.tolist()}; give it three sides that are finite and above 0.")
        object.__setattr__(self, "size", size)

    @classmethod
    def axis_aligned(cls, low: Any, high: Any) -> Box:
        """The box in world axes with the corners `low` [3] and `high` [3]."""
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        pose = np.eye(4)
        pose[:3, 3] = (low + high) / 2
        return cls(pose, high - low)

    @classmethod
    def from_matrix(cls, matrix: NDArray[Any]) -> Box:
        """The cube [-1, 1]^3 transformed by a matrix [4, 4], as Blender draws a cube empty of display size 1.

        Raises SnergError when the matrix is not finite, singular or sheared.
        """
        matrix = np.asarray(matrix, np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise SnergError("The box has a matrix that is not a finite 4 x 4; reset its transform.")
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
        if lengths.min() < 1e-12:
            raise SnergError("The box has no volume; scale it above 0 on all three axes.")
        cosines = (matrix[:3, :3] / lengths).T @ (matrix[:3, :3] / lengths) - np.eye(3)
        if np.abs(cosines).max() > MAX_SHEAR:
            raise SnergError("The box is sheared by a parent that is turned and scaled unevenly; apply the parent's scale, or clear it.")
        pose = matrix.copy()
        if np.linalg.det(pose[:3, :3]) < 0:  # a box is symmetric: mirrored, it is the same box with one axis reversed
            pose[:3, 0] *= -1
        return cls(pose, 2 * lengths)

    def to_json(self) -> dict[str, Any]:
        """{"box_to_world": 4 rows, "size": [x, y, z]}"""
        return {"box_to_world": self.box_to_world.tolist(), "size": self.size.tolist()}

    @classmethod
    def from_json(cls, value: Any, where: str = "The box") -> Box:
        """From the result of `to_json`, {"matrix": 4 rows} (see `from_matrix`) or {"min": [3], "max": [3]}.

        Raises SnergError, which begins with `where`, for anything else.
        """
        try:
            if "matrix" in value:
                return cls.from_matrix(np.array(value["matrix"], np.float64))
            if "min" in value:
                return cls.axis_aligned(value["min"], value["max"])
            return cls(np.array(value["box_to_world"], np.float64), np.array(value["size"], np.float64))
        except SnergError:
            raise
        except Exception as error:  # a value of another type may raise any exception
            raise SnergError(f'{where} is not a box: it needs "min" and "max", or "box_to_world" and "size", or "matrix".') from error

    @classmethod
    def read(cls, path: Path) -> Box:
        """The box in a JSON file (see `from_json`). Raises SnergError when it holds none."""
        return cls.from_json(read_json(path), str(path))

    def contains(self, points: NDArray[Any]) -> NDArray[Any]:
        """Whether world points [N, 3] lie in the box, bool [N]."""
        local = (points - self.box_to_world[:3, 3]) @ self.box_to_world[:3, :3]
        return np.asarray((np.abs(local) <= self.size / 2).all(axis=-1))

    def corners(self) -> NDArray[Any]:
        """The corners [8, 3] in world units."""
        signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1).reshape(8, 3)
        return np.asarray((signs * self.size / 2) @ self.box_to_world[:3, :3].T + self.box_to_world[:3, 3])
