"""Validation of values from JSON and arrays. All functions raise ValueError that names the value; readers turn it into a SnergError."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import clean

FAR = 1e12  # largest length or coordinate, in any unit: squares and products of larger ones overflow float32
ORTHONORMAL_TOLERANCE = 1e-3  # largest element of |R^T R - I| of a rotation R


def shown(value: Any) -> str:
    """A value as text of at most 80 characters, for an error message."""
    return clean(repr(value), 80)


def number(value: Any, name: str, low: float = -FAR, high: float = FAR) -> float:
    """A finite number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:  # false for NaN
        raise ValueError(f"{name} is {shown(value)}; it must be a number from {low:g} to {high:g}")
    return float(value)


def positive(value: Any, name: str) -> float:
    """A finite number above 0."""
    return number(value, name, 1 / FAR)


def whole(value: Any, name: str, low: int, high: int) -> int:
    """A whole number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(f"{name} is {shown(value)}; it must be a whole number from {low} to {high}")
    return value


def flag(value: Any, name: str) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} is {shown(value)}; it must be true or false")
    return value


def text(value: Any, name: str) -> str:
    """A text."""
    if not isinstance(value, str):
        raise ValueError(f"{name} is {shown(value)}; it must be a text")
    return value


def record(value: Any, name: str) -> dict[str, Any]:
    """A JSON object."""
    if not isinstance(value, dict):
        raise ValueError(f"{name} is {shown(value)}; it must be an object")
    return value


def numbers(value: Any, name: str, shape: tuple[int, ...], most: float = FAR) -> NDArray[Any]:
    """Finite numbers as an array of the same shape as `shape`, float64; none beyond `most` in magnitude."""
    found = np.asarray(value)
    if found.shape != shape or found.dtype.kind not in "fiu":
        raise ValueError(f"{name} is {found.dtype} {found.shape}; it must be {' x '.join(map(str, shape))} numbers")
    found = found.astype(np.float64)
    if not (np.abs(found) <= most).all():
        raise ValueError(f"{name} holds a value that is not finite or beyond {most:g}")
    return found


def rotation(value: Any, name: str) -> NDArray[Any]:
    """A rotation [3, 3] float64: orthonormal, without reflection."""
    axes = numbers(value, name, (3, 3))
    if np.abs(axes.T @ axes - np.eye(3)).max() > ORTHONORMAL_TOLERANCE or np.linalg.det(axes) < 0:
        raise ValueError(f"{name} is no rotation: its axes must be 1 long and at right angles")
    return axes


def pose(value: Any, name: str) -> NDArray[Any]:
    """A rigid pose [4, 4] float64: a rotation and a translation."""
    matrix = numbers(value, name, (4, 4))
    rotation(matrix[:3, :3], name)
    return matrix
