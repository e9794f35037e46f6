"""Normalised device coordinates, in which a forward-facing scene fits a box although it reaches to infinity (NeRF, appendix C).

Space: what a field and its scene are laid out in, the world itself or its NDC. Straight lines stay straight in NDC, so
that only rays are mapped; all that follows is the same in both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from .camera import rigid

PARALLEL = 1e-6  # rays whose direction has less of the axis than this never reach the depths that NDC are about
NEAREST = 1e-9  # smallest z / near, and smallest 1 - z', that are told from 0
BEYOND = np.array([0.0, 0.0, 2.0])  # where rays begin that miss: past infinity, on their way out


@dataclass(frozen=True, eq=False)
class Ndc:
    """x' = -fx x / z, y' = -fy y / z, z' = 1 + 2 near / z in the axes of a camera that stands for all.

    camera_to_world: [4, 4] float64 rigid, looking down -z. focal: (fx, fy) divided by half the picture's width and height,
    so that its edges are at x' = +-1 and y' = +-1. near: world units; depth `near` is z' = -1, infinity is z' = 1.
    Raises SnergError when a value is not finite and above 0.
    """

    camera_to_world: NDArray[Any]
    focal: tuple[float, float]
    near: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera_to_world", rigid(self.camera_to_world, "The forward-facing frame"))
        if len(self.focal) != 2 or not all(math.isfinite(v) and v > 0 for v in (*self.focal, self.near)):
            raise SnergError(
                f"The forward-facing frame has focal lengths {self.focal} and near {self.near}; they must be finite and above 0."
            )

    def to_json(self) -> dict[str, Any]:
        """JSON values, for `from_json`."""
        return {
            "camera_to_world": self.camera_to_world.tolist(),
            "focal": [float(f) for f in self.focal],
            "near": float(self.near),
        }

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Ndc:
        """Undo `to_json`. Raises KeyError, TypeError or ValueError where it is something else, SnergError on bad numbers."""
        x, y = value["focal"]
        return cls(np.array(value["camera_to_world"], np.float64), (float(x), float(y)), float(value["near"]))

    def from_world(self, points: NDArray[Any]) -> NDArray[Any]:
        """[N, 3] world to NDC, float64. Always finite: what is not in front of the camera comes out far below z' = -1."""
        local = self._local(points)
        return self._device(local[:, :2], np.minimum(local[:, 2], -NEAREST * self.near))

    def to_world(self, points: NDArray[Any]) -> NDArray[Any]:
        """[N, 3] NDC to the world, float64. Always finite: z' >= 1 comes out 2e9 times as far as near."""
        points = np.asarray(points, np.float64)
        z = self._depth(points[:, 2])
        local = np.stack([-points[:, 0] * z / self.focal[0], -points[:, 1] * z / self.focal[1], z], axis=-1)
        return np.asarray(local @ self.camera_to_world[:3, :3].T + self.camera_to_world[:3, 3])

    def rays(
        self, origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any] | float
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
        """See `space_rays`."""
        start, toward, alive = self._starts(origins, directions, near)
        point = np.where(alive[:, None], self._device(start[:, :2], start[:, 2]), BEYOND)
        # The derivative of the device coordinates along the ray, times a positive number that leaves no division.
        along = toward[:, 2:] * point[:, :2] + np.array(self.focal) * toward[:, :2]
        direction = np.concatenate([along, -toward[:, 2:] * (1 - point[:, 2:])], axis=-1)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        direction = np.where(alive[:, None], direction, [0.0, 0.0, 1.0])
        far = np.where(alive, (1 - point[:, 2]) / direction[:, 2], 0)
        return point, direction, np.zeros(len(point)), far

    def distance(
        self, origins: NDArray[Any], directions: NDArray[Any], along: NDArray[Any], near: NDArray[Any] | float = 0.0
    ) -> NDArray[Any]:
        """World distance [N] float64 along rays as given to `rays`, at distance `along` [N] on what `rays` made of them.

        Finite: infinity comes out as in `to_world`. Rays that miss give their own `near`.
        """
        point, direction, _, _ = self.rays(origins, directions, near)
        _, toward, alive = self._starts(origins, directions, near)
        z = self._depth(point[:, 2] + along * direction[:, 2])
        return np.where(alive, (z - self._local(origins)[:, 2]) / toward[:, 2], near)

    def _local(self, points: NDArray[Any]) -> NDArray[Any]:
        return np.asarray((np.asarray(points, np.float64) - self.camera_to_world[:3, 3]) @ self.camera_to_world[:3, :3])

    def _device(self, xy: NDArray[Any], z: NDArray[Any]) -> NDArray[Any]:
        """Camera axes to NDC; z < 0."""
        return np.concatenate([-np.array(self.focal) * xy / z[:, None], (1 + 2 * self.near / z)[:, None]], axis=-1)

    def _depth(self, z: NDArray[Any]) -> NDArray[Any]:
        """z of the camera's axes where z' is the NDC."""
        return -2 * self.near / np.maximum(1 - z, NEAREST)

    def _starts(
        self, origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any] | float
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Where rays begin [N, 3] and their directions [N, 3], camera axes, and which hit [N] bool; any point and the axis else."""
        origin = self._local(origins)
        toward = np.asarray(directions, np.float64) @ self.camera_to_world[:3, :3]
        alive = toward[:, 2] < -PARALLEL  # hard case 9: others are parallel to the near plane, or look away from it
        toward = np.where(alive[:, None], toward, [0.0, 0.0, -1.0])
        begin = np.maximum(near, (-self.near - origin[:, 2]) / toward[:, 2])
        start = origin + begin[:, None] * toward
        start[:, 2] = np.minimum(start[:, 2], -self.near)  # rounding may leave it a little in front
        return np.where(alive[:, None], start, [0.0, 0.0, -self.near]), toward, alive


def space_rays(
    ndc: Ndc | None, origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any] | float = 0.0
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """World rays (origins and unit directions [N, 3], near [N] or a float >= 0) to (origins, unit directions, near, far) in space.

    Without NDC they stay as they are, far is infinite. With NDC they begin at the near plane, or at `near` where that is
    further, so that near is 0; far is where they reach infinity, z' = 1. Rays that run parallel to the near plane or away from
    it are misses (hard case 9): far = near, and they begin outside every box that ends at z' = 1 or little after it, on their
    way out, so that they meet none. All finite, float64.
    """
    if ndc is not None:
        return ndc.rays(origins, directions, near)
    count = len(origins)
    return origins, directions, np.broadcast_to(np.asarray(near, np.float64), (count,)), np.full(count, np.inf)


def world_distance(
    ndc: Ndc | None, origins: NDArray[Any], directions: NDArray[Any], along: NDArray[Any], near: NDArray[Any] | float = 0.0
) -> NDArray[Any]:
    """World distance [N] float64 at distance `along` [N] on what `space_rays` made of the same world rays."""
    return np.asarray(along, np.float64) if ndc is None else ndc.distance(origins, directions, along, near)
