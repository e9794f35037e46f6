"""Normalised device coordinates (NDC), in which an unbounded forward-facing scene fits into a box (Mildenhall et al. 2020, appendix C).

'Space' is where a field and its scene are defined: the world, or NDC. Straight lines stay straight in NDC, so that mapping the rays
is enough, and everything after that is the same in both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from .camera import rigid

PARALLEL_EPSILON = 1e-6  # smallest component of a unit direction along the view axis; rays below it never reach the near plane
DEPTH_EPSILON = 1e-9  # lower bound of z / near and of 1 - z', which are divisors
MISS_ORIGIN = np.array([0.0, 0.0, 2.0])  # origin in NDC of rays that miss: beyond infinity (z' = 1), and they point away from it


@dataclass(frozen=True, eq=False)
class Ndc:
    """NDC of one camera that stands for all: x' = -fx x / z, y' = -fy y / z, z' = 1 + 2 near / z, where x, y, z are in its axes.

    Depth `near` is z' = -1, infinity is z' = 1. Raises SnergError when a value is not finite and above 0.
    """

    camera_to_world: NDArray[Any]  # [4, 4] float64, rigid, looking down -z
    focal: tuple[float, float]  # (fx, fy) over half the image's width and height: its borders are x' = +-1 and y' = +-1
    near: float  # world units

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
        """World points [N, 3] to NDC, [N, 3] float64. Always finite: points behind the camera get a z' far below -1."""
        local = self._local(points)
        return self._device(local[:, :2], np.minimum(local[:, 2], -DEPTH_EPSILON * self.near))

    def to_world(self, points: NDArray[Any]) -> NDArray[Any]:
        """Points [N, 3] in NDC to the world, [N, 3] float64. Always finite: z' >= 1 gives the depth 2e9 near."""
        points = np.asarray(points, np.float64)
        z = self._depth(points[:, 2])
        local = np.stack([-points[:, 0] * z / self.focal[0], -points[:, 1] * z / self.focal[1], z], axis=-1)
        return np.asarray(local @ self.camera_to_world[:3, :3].T + self.camera_to_world[:3, 3])

    def rays(
        self, origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any] | float, far: NDArray[Any] | None = None
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
        """World rays (origins and unit directions [N, 3]) to rays in NDC with near and far [N]: see `space_rays`."""
        start, toward, alive = self._starts(origins, directions, near)
        point = np.where(alive[:, None], self._device(start[:, :2], start[:, 2]), MISS_ORIGIN)
        # The derivative of the device coordinates along the ray, times a positive number that leaves no division.
        along = toward[:, 2:] * point[:, :2] + np.array(self.focal) * toward[:, :2]
        direction = np.concatenate([along, -toward[:, 2:] * (1 - point[:, 2:])], axis=-1)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        direction = np.where(alive[:, None], direction, [0.0, 0.0, 1.0])
        end = 1.0 if far is None else self._device_depth(self._local(origins)[:, 2] + far * toward[:, 2])
        length = np.where(alive, (end - point[:, 2]) / direction[:, 2], 0)
        return point, direction, np.zeros(len(point)), np.maximum(length, 0)

    def distance(
        self, origins: NDArray[Any], directions: NDArray[Any], along: NDArray[Any], near: NDArray[Any] | float = 0.0
    ) -> NDArray[Any]:
        """World distances [N] float64 along world rays (origins, directions [N, 3]), given distances `along` [N] on the same rays in NDC.

        Always finite, as in `to_world`. Rays that miss get their own `near`.
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

    def _device_depth(self, z: NDArray[Any]) -> NDArray[Any]:
        """z' in NDC [N] from z in the camera's axes [N]; far below -1 behind the camera. The inverse of `_depth`."""
        return np.asarray(1 + 2 * self.near / np.minimum(z, -DEPTH_EPSILON * self.near))

    def _depth(self, z: NDArray[Any]) -> NDArray[Any]:
        """z in the camera's axes [N] from z' in NDC [N]."""
        return -2 * self.near / np.maximum(1 - z, DEPTH_EPSILON)

    def _starts(
        self, origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any] | float
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Ray origins [N, 3] on or beyond the near plane, directions [N, 3], both in camera axes, and which rays hit, bool [N].

        Rays that miss get an arbitrary origin and the view axis as direction.
        """
        origin = self._local(origins)
        toward = np.asarray(directions, np.float64) @ self.camera_to_world[:3, :3]
        alive = toward[:, 2] < -PARALLEL_EPSILON  # other rays are parallel to the near plane or point away from it (hard case 9)
        toward = np.where(alive[:, None], toward, [0.0, 0.0, -1.0])
        begin = np.maximum(near, (-self.near - origin[:, 2]) / toward[:, 2])
        start = origin + begin[:, None] * toward
        start[:, 2] = np.minimum(start[:, 2], -self.near)  # rounding may put it in front of the near plane
        return np.where(alive[:, None], start, [0.0, 0.0, -self.near]), toward, alive


def space_rays(
    ndc: Ndc | None,
    origins: NDArray[Any],
    directions: NDArray[Any],
    near: NDArray[Any] | float = 0.0,
    far: NDArray[Any] | None = None,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Convert world rays to the space in which the field is sampled: NDC, or the world where `ndc` is None.

    origins, directions: [N, 3], the directions of length 1. near: [N] or one float >= 0, distance in world units at which a ray begins;
    far: [N], at which it ends, infinite where it is None.
    Returns (origins [N, 3], unit directions [N, 3], near [N], far [N]), float64, lengths in units of that space.
    Without NDC the rays are unchanged. With NDC a ray begins at the near plane, or at `near` where that is
    farther, so that its near is 0; an infinite far is the distance to z' = 1. A ray that is parallel to the
    near plane or points away from it sees nothing (hard case 9): its far equals its near, and its origin and direction are chosen
    so that it meets no box that ends near z' = 1. All results are finite, except an infinite far without NDC.
    """
    if ndc is not None:
        return ndc.rays(origins, directions, near, far)
    count = len(origins)
    return origins, directions, np.broadcast_to(np.asarray(near, np.float64), (count,)), np.full(count, np.inf) if far is None else far


def world_distance(
    ndc: Ndc | None, origins: NDArray[Any], directions: NDArray[Any], along: NDArray[Any], near: NDArray[Any] | float = 0.0
) -> NDArray[Any]:
    """World distances [N] float64 along world rays ([N, 3] each), given distances `along` [N] on the rays of `space_rays`."""
    return np.asarray(along, np.float64) if ndc is None else ndc.distance(origins, directions, along, near)
