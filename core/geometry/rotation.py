"""Rotations as unit quaternions (x, y, z, w), in the order of glTF and three.js."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NEARLY_SAME = 1e-9  # radians between two quaternions below which spherical and linear interpolation are equal in float64


def quaternion(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit quaternion [4] of a rotation [3, 3], with w >= 0 (Shepperd's method: the largest component is divided by)."""
    m = np.asarray(matrix, np.float64)
    trace = np.trace(m)
    squares = np.array([1 + 2 * m[0, 0] - trace, 1 + 2 * m[1, 1] - trace, 1 + 2 * m[2, 2] - trace, 1 + trace]) / 4
    largest = int(np.argmax(squares))
    products = np.array(
        [
            [4 * squares[0], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
            [m[0, 1] + m[1, 0], 4 * squares[1], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 4 * squares[2], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 4 * squares[3]],
        ]
    )[largest]
    found = products / np.linalg.norm(products)
    return np.asarray(-found if found[3] < 0 else found)


def rotation_matrix(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation [3, 3] of a quaternion [4] of any length but 0."""
    return np.asarray(rotation_matrices((value / np.linalg.norm(value))[None])[0])


def rotation_matrices(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotations [N, 3, 3] of unit quaternions [N, 4]."""
    x, y, z, w = values.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The product [..., 4] of quaternions: the rotation b, then a."""
    (ax, ay, az, aw), (bx, by, bz, bw) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bx + bw * ax + ay * bz - az * by,
            aw * by + bw * ay + az * bx - ax * bz,
            aw * bz + bw * az + ax * by - ay * bx,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def slerp(a: NDArray[np.float64], b: NDArray[np.float64], parts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spherical interpolation [N, 4] from unit quaternion a [4] (part 0) to b [4] (part 1), the shorter way, for parts [N]."""
    if a @ b < 0:
        b = -b
    angle = 2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))
    parts = parts[:, None]
    if angle < NEARLY_SAME:
        return np.asarray(a + (b - a) * parts)
    return np.asarray((np.sin((1 - parts) * angle) * a + np.sin(parts * angle) * b) / np.sin(angle))
