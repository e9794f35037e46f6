"""Cameras: intrinsics, pose and the rays of their pixels.

OpenGL convention: x right, y up, looking down -z; the world is Blender's, z up. Pixel (column, row) has
its centre at (column + 0.5, row + 0.5), row 0 at the top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..errors import SnergError

PROJECTIONS = ("perspective", "orthographic")


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole or parallel camera.

    width, height: pixels.
    focal: (x, y) in pixels; for an orthographic camera, pixels per world unit.
    centre: (x, y) principal point in pixels from the top left corner.
    camera_to_world: [4, 4] float64, rigid (see `rigid`).
    projection: 'perspective' or 'orthographic'.
    near: distance along the ray, in world units, before which nothing is seen.
    """

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    camera_to_world: np.ndarray
    projection: str = "perspective"
    name: str = ""
    near: float = 0.0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise SnergError(f"Camera {self.name!r} has a picture of {self.width} x {self.height} pixels; both must be 1 or more.")
        if self.projection not in PROJECTIONS:
            raise SnergError(f"Camera {self.name!r} is {self.projection}; only perspective and orthographic cameras are supported.")
        if not all(math.isfinite(f) and f > 0 for f in self.focal):
            raise SnergError(f"Camera {self.name!r} has a focal length of {self.focal} pixels; it must be finite and above 0.")
        if not np.isfinite(self.centre).all():
            raise SnergError(f"Camera {self.name!r} has a principal point of {self.centre}; it must be finite.")
        object.__setattr__(self, "camera_to_world", rigid(self.camera_to_world, f"Camera {self.name!r}"))

    @property
    def position(self) -> np.ndarray:
        """[3] float64, world units."""
        return self.camera_to_world[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another number of pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            focal=(self.focal[0] * sx, self.focal[1] * sy),
            centre=(self.centre[0] * sx, self.centre[1] * sy),
        )

    def rays(self, pixels: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions through pixel centres, world axes, float64.

        pixels: [N, 2] (column, row) integers; all pixels, row by row, when None. Returns ([N, 3], [N, 3]).
        """
        if pixels is None:
            rows, columns = np.mgrid[0 : self.height, 0 : self.width]
            pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1)
        x = (pixels[:, 0] + 0.5 - self.centre[0]) / self.focal[0]
        y = -(pixels[:, 1] + 0.5 - self.centre[1]) / self.focal[1]
        rotation, position = self.camera_to_world[:3, :3], self.position
        if self.projection == "orthographic":
            origins = position + np.stack([x, y, np.zeros_like(x)], axis=-1) @ rotation.T
            return origins, np.broadcast_to(-rotation[:, 2], origins.shape).copy()
        directions = np.stack([x, y, -np.ones_like(x)], axis=-1) @ rotation.T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.broadcast_to(position, directions.shape).copy(), directions

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points [N, 3] to (pixel coordinates [N, 2], depth along the view axis [N])."""
        local = (points - self.position) @ self.camera_to_world[:3, :3]
        depth = -local[:, 2]
        scale = np.ones_like(depth) if self.projection == "orthographic" else 1 / np.where(depth == 0, np.inf, depth)
        return np.stack(
            [
                self.centre[0] + self.focal[0] * local[:, 0] * scale,
                self.centre[1] - self.focal[1] * local[:, 1] * scale,
            ],
            axis=-1,
        ), depth


def focal_from_angle(angle: float, pixels: int, where: str) -> float:
    """Focal length in pixels of a field of view in radians.

    Raises SnergError unless 0 < angle < pi (hard case 4).
    """
    if not (math.isfinite(angle) and 1e-6 < angle < math.pi - 1e-6):
        raise SnergError(f"{where} has a field of view of {angle} radians; it must lie between 0 and pi.")
    return 0.5 * pixels / math.tan(0.5 * angle)


def rigid(matrix: np.ndarray, where: str) -> np.ndarray:
    """[4, 4] pose with the scale taken out of its axes, float64 (hard case 5).

    Raises SnergError when the matrix is not finite, is flat, or mirrors.
    """
    matrix = np.array(matrix, dtype=np.float64)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise SnergError(f"{where} has a pose that is not a finite 4 x 4 matrix; check the file that it came from.")
    axes = matrix[:3, :3]
    lengths = np.linalg.norm(axes, axis=0)
    if lengths.min() < 1e-12:
        raise SnergError(f"{where} has a pose with an axis of length 0; give the object a scale other than 0.")
    determinant = np.linalg.det(axes / lengths)
    if determinant < 1e-3:
        what = "mirrors space" if determinant < -1e-3 else "is flat"
        raise SnergError(f"{where} has a pose that {what}; its scale must be positive and its axes independent.")
    u, _, vt = np.linalg.svd(axes / lengths)
    result = np.eye(4)
    result[:3, :3] = u @ vt
    result[:3, 3] = matrix[:3, 3]
    return result
