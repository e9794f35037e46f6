"""Cameras that see more than a half space: panoramas and fisheyes past 180 degrees. Their pixels are angles from the view axis.

Flat coordinates are pixels from the principal point divided by the focal length, which is pixels a radian; x right, y down. Local
directions have OpenGL's axes: x right, y up, looking down -z.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

PROJECTIONS = ("equirectangular", "fisheye")
OUTSIDE = 1e9  # flat coordinate of a point that a lens does not see: outside of any picture
EQUISOLID = (-1 / 24, 1 / 1920, -1 / 322560, 1 / 92897280)  # 2 sin(theta / 2) as theta (1 + k1 theta^2 + ...), to 1e-5 up to 180 degrees
TABLE_SIZE = 4096  # entries of the table of initial angles
NEWTON_STEPS = 3  # from the table they reach 1e-12

Coefficients = tuple[float, ...]  # k1 .. k4 of a fisheye (see Distortion)


def directions(projection: str, flat: NDArray[Any], k: Coefficients = ()) -> NDArray[Any]:
    """Local unit directions [N, 3] float64 of flat coordinates [N, 2]. k: of a fisheye; beyond its last angle the lens goes on linearly."""
    x, y = np.asarray(flat, np.float64).T
    if projection == "equirectangular":
        return np.stack([np.sin(x) * np.cos(y), -np.sin(y), -np.cos(x) * np.cos(y)], axis=-1)
    radius = np.hypot(x, y)
    angle = np.minimum(angles(radius, k), math.pi)
    across = np.where(radius > 1e-12, np.sin(angle) / np.maximum(radius, 1e-12), 1.0)
    return np.stack([x * across, -y * across, -np.cos(angle)], axis=-1)


def flats(projection: str, local: NDArray[Any], k: Coefficients, widest: float) -> NDArray[Any]:
    """Flat coordinates [N, 2] float64 of local points [N, 3]; OUTSIDE for a fisheye's beyond the angle `widest` (radians) or its fold."""
    x, y, z = np.asarray(local, np.float64).T
    if projection == "equirectangular":
        return np.stack([np.arctan2(x, -z), -np.arctan2(y, np.hypot(x, z))], axis=-1)
    across = np.hypot(x, y)
    angle = np.arctan2(across, -z)
    seen = angle <= min(widest, last_angle(k))
    scale = np.where(across > 1e-300, distorted(np.minimum(angle, last_angle(k)), k) / np.maximum(across, 1e-300), 1.0)
    return np.where(seen[:, None], np.stack([x * scale, -y * scale], axis=-1), OUTSIDE)


def stretch(projection: str, flat: NDArray[Any], k: Coefficients) -> NDArray[Any]:
    """How much longer than in the middle an angle is at flat coordinates [N, 2], in its longest direction, [N] float64."""
    if projection == "equirectangular":
        return np.asarray(1 / np.maximum(np.cos(flat[:, 1]), 1e-9))
    radius = np.linalg.norm(flat, axis=-1)
    angle = np.minimum(angles(radius, k), math.pi)
    around = np.where(angle > 1e-6, radius / np.maximum(np.sin(angle), 1e-9), 1.0)
    return np.maximum(around, _slope(angle, k))


def distorted(angle: NDArray[Any], k: Coefficients) -> NDArray[Any]:
    """theta (1 + k1 theta^2 + k2 theta^4 + ...) of angles [N] (Kannala and Brandt 2006), [N] float64."""
    square, factor = angle * angle, np.zeros_like(angle)
    for value in reversed(k):
        factor = (factor + value) * square
    return np.asarray(angle * (1 + factor))


def angles(radius: NDArray[Any], k: Coefficients) -> NDArray[Any]:
    """The angles [N] that `distorted` takes to radii [N]; beyond the last one, its continuation with slope 1."""
    if not any(k):
        return np.asarray(radius, np.float64)
    last, known = last_angle(k), _table(k)
    end = float(known[-1])
    angle = np.interp(radius, known, np.linspace(0, last, TABLE_SIZE))
    for _ in range(NEWTON_STEPS):
        slope = np.maximum(_slope(angle, k), 1e-6)
        angle = np.clip(angle - (distorted(angle, k) - np.minimum(radius, end)) / slope, 0, last)
    return np.asarray(angle + np.maximum(radius - end, 0))


def _slope(angle: NDArray[Any], k: Coefficients) -> NDArray[Any]:
    square, factor = angle * angle, np.zeros_like(angle)
    for power, value in reversed(list(enumerate(k, 1))):
        factor = (factor + (2 * power + 1) * value) * square
    return np.asarray(1 + factor)


@lru_cache(maxsize=64)
def last_angle(k: Coefficients) -> float:
    """The angle up to which `distorted` increases, at most pi: beyond it the polynomial folds back."""
    steps = np.linspace(0, math.pi, TABLE_SIZE)
    falls = np.flatnonzero(_slope(steps, k) <= 1e-6)
    return float(steps[max(falls[0] - 1, 1)]) if len(falls) else math.pi


@lru_cache(maxsize=64)
def _table(k: Coefficients) -> NDArray[Any]:
    return distorted(np.linspace(0, last_angle(k), TABLE_SIZE), k)
