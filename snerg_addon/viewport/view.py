"""What the shader must know of a view: rays in voxels along the axes of a baked scene that stands where its object does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...core.geometry.box import Box
from ...core.geometry.camera import Camera
from ...core.scene.scene import Scene


class Part(NamedTuple):
    """A rectangle of a picture, in pixels from its lower left corner."""

    left: int
    bottom: int
    width: int
    height: int

    @property
    def pixels(self) -> int:
        """How many it has."""
        return self.width * self.height

    def rows(self, first: int, count: int) -> Part:
        """Some of its rows, counted from the top."""
        return Part(self.left, self.bottom + self.height - first - count, self.width, count)

    def scaled(self, before: tuple[int, int], after: tuple[int, int]) -> Part:
        """The least rectangle that holds this one in a picture of another size."""
        left, bottom = self.left * after[0] // before[0], self.bottom * after[1] // before[1]
        right = -(-(self.left + self.width) * after[0] // before[0])
        top = -(-(self.bottom + self.height) * after[1] // before[1])
        return Part(left, bottom, right - left, top - bottom)


@dataclass(frozen=True, eq=False)
class Projection:
    """A picture's rays in the camera's own axes: the plane at distance 1 is ndc * scale + offset, x right and y up (parallel rays: the
    plane itself, in world units). near, far: clip planes, world units along the view axis. matrix: [4, 4], the camera to clip space.
    """

    scale: tuple[float, float]
    offset: tuple[float, float]
    parallel: bool
    near: float
    far: float
    matrix: np.ndarray

    @classmethod
    def from_matrix(cls, window: np.ndarray) -> Projection:
        """From Blender's window matrix [4, 4] of a viewport or a camera: x_ndc = (P00 x + P02 z + P03) / w."""
        p = np.asarray(window, np.float64)
        parallel = bool(abs(p[3, 2]) < 1e-12)
        side = p[:2, 3] if parallel else p[:2, 2]
        x, y = (-side if parallel else side) / (p[0, 0], p[1, 1])
        corners = np.linalg.inv(p) @ np.array([[0, 0], [0, 0], [-1, 1], [1, 1]], np.float64)
        near, far = -corners[2] / corners[3]
        return cls((1 / p[0, 0], 1 / p[1, 1]), (float(x), float(y)), parallel, float(near), float(far), p)


def camera_of(projection: Projection, camera_to_world: np.ndarray, width: int, height: int) -> tuple[Camera, float]:
    """A view of so many pixels as a Camera, and how far it stands behind the view's own plane: a parallel view of Blender sees what lies
    behind its plane, a Camera does not. Any scale in camera_to_world [4, 4] is left out, as Blender does."""
    pose = np.array(camera_to_world, np.float64)
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    back = max(-projection.near, 0.0)
    pose[:3, 3] += back * pose[:3, 2]
    focal = width / 2 / projection.scale[0], height / 2 / projection.scale[1]
    centre = width / 2 - projection.offset[0] * focal[0], height / 2 + projection.offset[1] * focal[1]
    return Camera(width, height, focal, centre, pose, "orthographic" if projection.parallel else "perspective", "Viewport"), back


def placed(scene: Scene, matrix: np.ndarray) -> np.ndarray:
    """[4, 4] float64, the scene's grid to the world, where its object has the world matrix [4, 4]: the object's own axes are those of
    the box that was baked, in the units in which it was baked."""
    return np.asarray(matrix, np.float64) @ np.linalg.inv(scene.box.box_to_world) @ scene.grid_to_world


def even_scale(matrix: np.ndarray, tolerance: float = 1e-4) -> float | None:
    """The scale of a world matrix [4, 4]; None where it is uneven, sheared, mirrored or 0, which a grid of cubes cannot follow."""
    axes = np.asarray(matrix, np.float64)[:3, :3]
    scale = float(np.cbrt(np.linalg.det(axes)))
    if not np.isfinite(scale) or scale <= 1e-12:
        return None
    return scale if np.abs(axes.T @ axes / scale**2 - np.eye(3)).max() < tolerance else None


def uniforms(scene: Scene, matrix: np.ndarray, camera_to_world: np.ndarray, projection: Projection) -> np.ndarray:
    """The shader's View [12, 4] float32 (see shader.py).

    matrix: of the scene's object, evenly scaled. camera_to_world: [4, 4], any scale in it is left out, as Blender does.
    """
    grid, camera = placed(scene, matrix), np.array(camera_to_world, np.float64)
    camera[:3, :3] /= np.linalg.norm(camera[:3, :3], axis=0)
    scale = float(np.cbrt(np.linalg.det(grid[:3, :3])))
    voxel = scene.voxel_size * scale
    turn = grid[:3, :3] / scale
    axes = turn.T @ camera[:3, :3]
    eye = turn.T @ (camera[:3, 3] - grid[:3, 3]) / voxel
    trained = scene.view_rotation @ scene.grid_to_world[:3, :3] @ axes  # the world as it was when the scene was baked
    unit = voxel if projection.parallel else 1.0
    found = np.zeros((12, 4))
    found[0:3, :3], found[3:6, :3] = axes.T, trained.T
    found[6] = [*eye, projection.parallel]
    found[7] = [*np.divide(projection.scale, unit), *np.divide(projection.offset, unit)]
    found[8, :3] = projection.near / voxel, projection.far / voxel, scene.near / scene.voxel_size
    found[9, :3], found[10, :3] = scene.shape, scene.indirection.shape
    found[11] = voxel
    return found.astype(np.float32)


def screen_part(scene: Scene, matrix: np.ndarray, camera_to_world: np.ndarray, projection: Projection, size: tuple[int, int]) -> Part:
    """The part of a picture of that size (width, height) in which a scene can be seen; all where it reaches behind the camera."""
    corners = np.concatenate([Box(np.eye(4), scene.box.size).corners(), np.ones((8, 1))], axis=1)  # in the object's own axes
    clip = corners @ (projection.matrix @ np.linalg.inv(camera_to_world) @ matrix).T
    if (clip[:, 3] <= 1e-9).any():
        return Part(0, 0, *size)
    pixels = (clip[:, :2] / clip[:, 3:] + 1) / 2 * size
    low = np.clip(np.floor(pixels.min(axis=0)), 0, size).astype(int).tolist()
    high = np.clip(np.ceil(pixels.max(axis=0)), 0, size).astype(int).tolist()
    return Part(low[0], low[1], high[0] - low[0], high[1] - low[1])
