"""Lens distortion by the models of OpenCV, which COLMAP, instant-ngp and nerfstudio use as well.

Normalised image coordinates are OpenCV's: x to the right, y down, both divided by depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError

MODELS = {
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "nerfstudio": ("k1", "k2", "k3", "k4", "p1", "p2"),
}
MAX_ANGLE = 89.9  # degrees from the optical axis up to which a lens is valid: x / depth is infinite at 90
TABLE_SIZE = 1024  # entries of the table of initial guesses
MAX_TABLE_RADIUS = 4.0  # distorted radius that the table covers at most
MAX_ITERATIONS = 12  # of Newton's method; two or three are enough away from the limit of a lens
TOLERANCE = 1e-11  # error of the distorted coordinates at which Newton's method stops
CHUNK = 2**16  # points undistorted at a time, which bounds the memory for a whole image


@dataclass(frozen=True)
class Distortion:
    """The distortion of a lens.

    'opencv': radial (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), and tangential with p1, p2. 'nerfstudio': the same
    with the radial factor 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, as in nerfstudio and Metashape. 'fisheye': the angle theta from the axis
    becomes theta (1 + k1 theta^2 + k2 theta^4 + ...), Kannala and Brandt 2006.

    A polynomial that was fitted inside an image may fold over outside it: beyond some ideal radius, its limit, the distorted radius
    decreases. Beyond the limit the lens is continued linearly, so that every pixel has one finite ray, and points outside the image
    stay outside. `is_valid` tells which points lie within the limit.
    Raises SnergError for another model, too many coefficients, or one that is not finite.
    """

    model: str  # one of MODELS
    coefficients: tuple[float, ...] = ()  # in the order of MODELS; missing ones are 0

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise SnergError(f"The lens model {self.model!r} is not known; undistort the images first, or use one of {', '.join(MODELS)}.")
        most = len(MODELS[self.model])
        values = tuple(float(c) for c in self.coefficients)
        if len(values) > most or not all(math.isfinite(v) for v in values):
            raise SnergError(f"The lens has the coefficients {values}; model {self.model!r} takes at most {most} finite numbers.")
        object.__setattr__(self, "coefficients", values + (0.0,) * (most - len(values)))

    def distort(self, xy: NDArray[Any]) -> NDArray[Any]:
        """Ideal normalised image coordinates [N, 2] to distorted ones, [N, 2] float64."""
        return self._lenses.distort(np.zeros(len(xy), np.int64), xy)

    def undistort(self, xy: NDArray[Any]) -> NDArray[Any]:
        """Distorted normalised image coordinates [N, 2] to ideal ones, [N, 2] float64; always finite."""
        return self._lenses.undistort(np.zeros(len(xy), np.int64), xy)

    def is_valid(self, xy: NDArray[Any]) -> NDArray[Any]:
        """Whether distorted coordinates [N, 2] lie within the limit of the lens, bool [N]: below its fold, less than 90 degrees from
        the axis."""
        return np.asarray(np.linalg.norm(self.undistort(xy), axis=-1) < self._lenses.limit[0] * (1 - 1e-9))

    def to_json(self) -> dict[str, Any]:
        """{"model", "coefficients"}"""
        return {"model": self.model, "coefficients": list(self.coefficients)}

    @classmethod
    def from_json(cls, value: Any) -> Distortion:
        """A lens from the result of `to_json`. Raises SnergError when it is anything else."""
        try:
            return cls(str(value["model"]), tuple(float(c) for c in value["coefficients"]))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, IndexError) as error:
            raise SnergError(f"A lens is not a model with coefficients ({error}).") from error

    @cached_property
    def _lenses(self) -> Lenses:
        return Lenses([self])


class Lenses:
    """Several lenses, for rays of many cameras at once: each point has the index of its lens."""

    def __init__(self, lenses: Sequence[Distortion]) -> None:
        self.fisheye = np.array([lens.model == "fisheye" for lens in lenses])
        self.coefficients = np.array([_row(lens) for lens in lenses])
        self.rational, self.tangential = bool(self.coefficients[:, 5:8].any()), bool(self.coefficients[~self.fisheye, 2:4].any())
        self.limit = np.array([_limit_radius(lens) for lens in lenses])  # [L] ideal radius up to which the distorted radius increases
        on_limit = np.stack([self.limit, np.zeros_like(self.limit)], axis=-1)
        distorted, _ = self._radial(self._parameters(np.arange(len(lenses))), on_limit)
        self.distorted_limit = np.linalg.norm(distorted, axis=-1)  # [L] distorted radius of the limit
        self.table_radius = np.minimum(self.distorted_limit, MAX_TABLE_RADIUS)
        self.table = np.stack([self._radius_table(i) for i in range(len(lenses))])

    def distort(self, lens: NDArray[Any], xy: NDArray[Any]) -> NDArray[Any]:
        """Ideal coordinates [N, 2] to distorted ones [N, 2] float64, point i by the lens of index lens[i]; lens: [N] int."""
        xy = np.asarray(xy, np.float64)
        radius = np.hypot(xy[:, 0], xy[:, 1])
        beyond = np.maximum(radius - self.limit[lens], 0)
        safe = np.maximum(radius, 1e-300)[:, None]
        held = xy * np.where(beyond > 0, self.limit[lens] / safe[:, 0], 1)[:, None]
        return np.asarray(self._distorted(self._parameters(lens), held)[0] + xy / safe * beyond[:, None])

    def undistort(self, lens: NDArray[Any], xy: NDArray[Any]) -> NDArray[Any]:
        """Distorted coordinates [N, 2] to ideal ones [N, 2] float64, point i by the lens of index lens[i]; lens: [N] int."""
        xy = np.asarray(xy, np.float64)
        if len(xy) <= CHUNK:
            return self._undistort(lens, xy)
        result = np.empty(xy.shape)
        for start in range(0, len(xy), CHUNK):
            part = slice(start, start + CHUNK)
            result[part] = self._undistort(lens[part], xy[part])
        return result

    def _undistort(self, lens: NDArray[Any], xy: NDArray[Any]) -> NDArray[Any]:
        radius = np.maximum(np.hypot(xy[:, 0], xy[:, 1]), 1e-300)
        guess = xy * (self._guess(lens, radius) / radius)[:, None]
        limit, of = self.limit[lens], self._parameters(lens)
        for _ in range(MAX_ITERATIONS):
            landed, (xx, xy_, yx, yy) = self._distorted(of, guess)
            error = xy - landed
            if not np.abs(error).max(initial=0) > TOLERANCE:
                break
            det = xx * yy - xy_ * yx
            det = np.where(np.abs(det) < 1e-9, np.inf, det)  # singular at the limit: no step
            guess = guess + np.stack([yy * error[:, 0] - xy_ * error[:, 1], xx * error[:, 1] - yx * error[:, 0]], axis=-1) / det[:, None]
            long = np.hypot(guess[:, 0], guess[:, 1])
            guess = guess * np.where(long > limit, limit / np.maximum(long, 1e-300), 1)[:, None]
        # Distorted points without an ideal one within the limit lie on its linear continuation.
        unsolved = np.abs(error).max(axis=-1) > 1e-6
        past = limit + np.maximum(radius - self.distorted_limit[lens], 0)
        return np.where(unsolved[:, None], xy * (past / radius)[:, None], guess)

    def _guess(self, lens: NDArray[Any], radius: NDArray[Any]) -> NDArray[Any]:
        place = np.minimum(radius / self.table_radius[lens], 1) * (TABLE_SIZE - 1)
        before = np.minimum(place.astype(np.int64), TABLE_SIZE - 2)
        low, high = self.table[lens, before], self.table[lens, before + 1]
        return np.asarray(low + (high - low) * (place - before))

    def _radius_table(self, index: int) -> NDArray[Any]:
        """Ideal radius [TABLE_SIZE] at even steps of the distorted radius up to `table_radius`, without tangential distortion."""
        ideal = np.tan(np.linspace(0, math.atan(self.limit[index]), 4 * TABLE_SIZE))
        ideal[-1] = self.limit[index]
        points = np.stack([ideal, np.zeros_like(ideal)], axis=-1)
        landed = self._radial(self._parameters(np.full(len(points), index)), points)[0][:, 0]
        return np.interp(np.linspace(0, self.table_radius[index], TABLE_SIZE), landed, ideal)

    def _parameters(self, lens: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Coefficients [9, N] (see `_row`) of each point's lens, and whether it is a fisheye, bool [N]."""
        return self.coefficients[lens].T, self.fisheye[lens]

    def _distorted(self, of: tuple[NDArray[Any], NDArray[Any]], xy: NDArray[Any]) -> tuple[NDArray[Any], tuple[NDArray[Any], ...]]:
        """Distorted coordinates [N, 2], and the Jacobian dx'/dx, dx'/dy, dy'/dx, dy'/dy, each [N]."""
        landed, (xx, mixed, yy) = self._radial(of, xy)
        if not self.tangential:
            return landed, (xx, mixed, mixed, yy)
        (_, _, p1, p2, *_), fisheye = of
        if fisheye.any():
            p1, p2 = np.where(fisheye, 0, p1), np.where(fisheye, 0, p2)
        x, y = xy[:, 0], xy[:, 1]
        square, across = x * x + y * y, 2 * (p1 * x + p2 * y)
        landed[:, 0] += 2 * p1 * x * y + p2 * (square + 2 * x * x)
        landed[:, 1] += p1 * (square + 2 * y * y) + 2 * p2 * x * y
        return landed, (xx + 2 * p1 * y + 6 * p2 * x, mixed + across, mixed + across, yy + 6 * p1 * y + 2 * p2 * x)

    def _radial(
        self, of: tuple[NDArray[Any], NDArray[Any]], xy: NDArray[Any]
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]:
        """The radial part s xy of both models, and its derivatives s + s' x^2, s' xy, s + s' y^2, where s' = (ds/dr) / r."""
        k, fisheye = of
        x, y = xy[:, 0], xy[:, 1]
        square = x * x + y * y
        scale, slope = _rational_scale(k, square) if self.rational else _polynomial_scale(k, square)
        if fisheye.any():
            bent = _fisheye_scale(k, square)
            scale, slope = np.where(fisheye, bent[0], scale), np.where(fisheye, bent[1], slope)
        return xy * scale[:, None], (scale + slope * x * x, slope * x * y, scale + slope * y * y)


def _row(lens: Distortion) -> tuple[float, ...]:
    """A lens's coefficients as Lenses holds them: those of 'opencv', then the factor of r^8; or those of 'fisheye', filled up to 9."""
    if lens.model == "nerfstudio":
        k1, k2, k3, k4, p1, p2 = lens.coefficients
        return k1, k2, p1, p2, k3, 0.0, 0.0, 0.0, k4
    return lens.coefficients + (0.0,) * (9 - len(lens.coefficients))


def _polynomial_scale(k: NDArray[Any], s: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Scale and (d scale / dr) / r of OpenCV's model without a denominator, coefficients [9, N], at squared radii s [N]."""
    k1, k2, _, _, k3, _, _, _, k8 = k
    return 1 + s * (k1 + s * (k2 + s * (k3 + s * k8))), 2 * (k1 + s * (2 * k2 + s * (3 * k3 + s * 4 * k8)))


def _rational_scale(k: NDArray[Any], s: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Scale and (d scale / dr) / r of OpenCV's model with the denominator, each [N]."""
    top, d_top = _polynomial_scale(k, s)
    _, _, _, _, _, k4, k5, k6, _ = k
    below, d_below = 1 + s * (k4 + s * (k5 + s * k6)), 2 * (k4 + s * (2 * k5 + s * 3 * k6))
    below = np.where(np.abs(below) < 1e-12, 1e-12, below)
    return top / below, (d_top * below - top * d_below) / (below * below)


def _fisheye_scale(k: NDArray[Any], s: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Scale and (d scale / dr) / r of the fisheye model, each [N]: scale = theta_d / r, with r = tan theta."""
    k1, k2, k3, k4, *_ = k
    r = np.sqrt(np.maximum(s, 1e-12))
    theta = np.arctan(r)
    t = theta * theta
    bent = theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    turn = (1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))) / (1 + r * r)
    return bent / r, (turn - bent / r) / (r * r)


def _limit_radius(lens: Distortion) -> float:
    """The ideal radius up to which the distorted radius increases: the first zero of its derivative, at most tan(MAX_ANGLE)."""
    k = _row(lens)
    widest = math.tan(math.radians(MAX_ANGLE))
    if lens.model == "fisheye":
        rising = np.polynomial.Polynomial([1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])  # in theta squared
        first = _first_zero(rising)
        return min(math.tan(math.sqrt(first)), widest) if first < (math.pi / 2) ** 2 else widest
    top: Any  # NumPy gives methods of its polynomials no types
    below: Any
    top, below = np.polynomial.Polynomial([1, k[0], k[1], k[4], k[8]]), np.polynomial.Polynomial([1, *k[5:8]])
    s = np.polynomial.Polynomial([0, 1])
    first = min(_first_zero(top * below + 2 * s * (top.deriv() * below - top * below.deriv())), _first_zero(below))
    return min(math.sqrt(first), widest)


def _first_zero(polynomial: Any) -> float:
    """The smallest positive real zero of a numpy.polynomial.Polynomial, infinite where there is none."""
    coefficients = np.trim_zeros(polynomial.coef, "b")
    if len(coefficients) < 2:
        return math.inf
    shortened: Any = np.polynomial.Polynomial(coefficients)
    zeros = shortened.roots()
    real = zeros[np.abs(zeros.imag) < 1e-9 * np.maximum(np.abs(zeros), 1e-3)].real
    return float(real[real > 0].min(initial=math.inf))
