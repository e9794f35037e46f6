"""Leaves out keys of a shot: the cameras stay where they were, within a quarter of a pixel."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .camera_path import Shot
from .camera_state import PLAIN, PLAIN_OF_CURVE, ROTATION, TURN, blended, curved, facing, hermite, pixel_errors, state_of
from .rotation import product

T = TypeVar("T")
CHUNK = 250  # frames that a step looks at: some milliseconds
TOLERANCE = 0.25  # pixels by which a thinned path may show a point elsewhere
STILL = 1e-3  # pixels by which a camera that stands still may move: rounding of Blender's float32 matrices
CURVE_PAYS = 3  # times as far as a line must a curve go: in a file it takes the room of two keys
SHORTEST_CURVE = 4  # frames: three between its ends say where two velocities lead


def thinned(shot: Shot, depths: NDArray[np.float64], centre: NDArray[np.float64], tolerance: float = TOLERANCE) -> Shot:
    """The shot with as few keys as found that keep every one of its cameras within `tolerance` pixels.

    shot: linear from key to key. depths: [keys, 2], as in `pixel_errors`. centre: [3] of what is shown.
    The camera turns around itself, around `centre`, or around the point that it looks at most of the time: whatever takes less room.
    """
    return drained(thin_steps(shot, depths, centre, tolerance))


def drained(steps: Generator[Any, None, T]) -> T:
    """What steps return, all of them taken."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return cast(T, end.value)


def thin_steps(
    shot: Shot, depths: NDArray[np.float64], centre: NDArray[np.float64], tolerance: float = TOLERANCE
) -> Generator[None, None, Shot]:  # fmt: skip
    """`thinned` in steps of CHUNK frames, so that a window can answer meanwhile. depths: [keys, 2]. centre: [3]."""
    found = [(yield from _thinned(Shot(shot.frames, shot.cameras), depths, tolerance))]
    if len(found[0].frames) > 2:
        axes = np.array([camera.camera_to_world[:3, 2] for camera in shot.cameras])
        places = np.array([camera.position for camera in shot.cameras])
        for point in (centre, looked_at(places, axes)):
            distances = np.maximum(((places - point) * axes).sum(axis=-1), 0.0)
            found.append((yield from _thinned(Shot(shot.frames, shot.cameras, tuple(map(float, distances))), depths, tolerance)))
    return min(found, key=lambda one: len(one.frames) + 2 * sum(curve is not None for curve in one.curves))


def looked_at(places: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The point [3] that is nearest, by least squares, to the view axes of cameras at places [N, 3] with unit axes [N, 3]."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = places.mean(axis=0)  # far from the origin, differences are taken first
    offset = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, places - middle), rcond=1e-6)[0]
    return np.asarray(middle + offset)


def _thinned(shot: Shot, depths: NDArray[np.float64], tolerance: float) -> Generator[None, None, Shot]:
    """From each key to the farthest frame that a line or a curve reaches within the tolerance."""
    samples = yield from Samples.steps_of(shot, depths, tolerance)
    chosen, curves, end = [0], [], len(shot.frames) - 1
    while chosen[-1] < end:
        first = chosen[-1]
        last, curve = (yield from farthest(samples.line_fits, first, first + 1, end)), None
        far = min(first + max(CURVE_PAYS * (last - first), SHORTEST_CURVE), end)
        if last < end and far - first >= SHORTEST_CURVE and (yield from samples.curve_fits(first, far)):
            last = yield from farthest(samples.curve_fits, first, far, end)
            curve = samples.curve(first, last)
        chosen.append(last)
        curves.append(curve)
    if len(chosen) == 2 and samples.still:
        chosen, curves = chosen[:1], []
    frames, distances = (tuple(values[i] for i in chosen) for values in (shot.frames, shot.distances))
    return Shot(frames, tuple(shot.cameras[i] for i in chosen), distances, tuple(curves))


def farthest(fits: Callable[[int, int], Generator[None, None, bool]], first: int, known: int, end: int) -> Generator[None, None, int]:
    """The last index up to `end` with fits(first, index), where `known` fits: by doubling the way, then by halving what is between."""
    good, bad = known, end + 1
    while good < end:
        tried = min(first + 2 * (good - first), end)
        if not (yield from fits(first, tried)):
            bad = tried
            break
        good = tried
    while bad - good > 1:
        tried = (good + bad) // 2
        if (yield from fits(first, tried)):
            good = tried
        else:
            bad = tried
    return good


@dataclass(frozen=True, eq=False)
class Samples:
    """A shot's states, and what a part of a path misses of them."""

    frames: NDArray[np.float64]  # [N]
    states: NDArray[np.float64]  # [N, 14]
    depths: NDArray[np.float64]  # [N, 2]
    like: Camera
    tolerance: float  # pixels

    @classmethod
    def steps_of(cls, shot: Shot, depths: NDArray[np.float64], tolerance: float) -> Generator[None, None, Samples]:
        """The samples of a shot, in steps. depths: [keys, 2], as of `thinned`; tolerance: pixels."""
        states = []
        for index, (camera, distance) in enumerate(zip(shot.cameras, shot.distances, strict=True)):
            states.append(state_of(camera, distance))
            if index % CHUNK == CHUNK - 1:
                yield
        return cls(np.array(shot.frames, np.float64), np.array(states), depths, shot.cameras[0], tolerance)

    @property
    def still(self) -> bool:
        """Whether the last state looks like the first."""
        return bool(pixel_errors(self.states[:1], self.states[-1:], self.like, self.depths[:1])[0] <= STILL)

    def line_fits(self, first: int, last: int) -> Generator[None, None, bool]:
        """Whether linear interpolation shows all that is between, in steps."""
        parts, _ = self._parts(first, last)
        return (yield from self._near(first, last, blended(self.states[first], self.states[last], parts)))

    def curve_fits(self, first: int, last: int) -> Generator[None, None, bool]:
        """Whether a curve shows all that is between, in steps."""
        parts, length = self._parts(first, last)
        guess = curved(self.states[first], self.states[last], self.curve(first, last), length, parts)
        return (yield from self._near(first, last, guess))

    def curve(self, first: int, last: int) -> NDArray[np.float64]:
        """The curve [2, 11] that is nearest, by least squares, to the states between; of those that are as near, the straightest."""
        parts, length = self._parts(first, last)
        a, b, inside = self.states[first], self.states[last], self.states[first + 1 : last]
        weights = hermite(parts, length)
        ends = np.hstack(weights[1:])  # [n, 2]
        plain, curve = list(PLAIN), np.zeros((2, 11))
        straight = (b - a)[plain] / length
        rest = inside[:, plain] - a[plain] - weights[0] * (b - a)[plain] - ends.sum(axis=1, keepdims=True) * straight
        curve[:, list(PLAIN_OF_CURVE)] = straight + np.linalg.lstsq(ends, rest, rcond=None)[0]
        curve[:, TURN] = fitted_turn(a[ROTATION], b[ROTATION], inside[:, ROTATION], weights, length)
        return curve

    def _parts(self, first: int, last: int) -> tuple[NDArray[np.float64], float]:
        length = float(self.frames[last] - self.frames[first])
        return (self.frames[first + 1 : last] - self.frames[first]) / length, length

    def _near(self, first: int, last: int, guess: NDArray[np.float64]) -> Generator[None, None, bool]:
        """Whether the states between two look as those of `guess` [last - first - 1, 14] do."""
        for start in range(first + 1, last, CHUNK):
            some = slice(start, min(start + CHUNK, last))
            guessed = guess[start - first - 1 :][:CHUNK]
            errors = pixel_errors(self.states[some], guessed, self.like, self.depths[some])
            near = bool(errors.max(initial=0.0) <= self.tolerance)
            yield
            if not near:
                return False
        return True


def fitted_turn(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    inside: NDArray[np.float64],
    weights: tuple[NDArray[np.float64], ...],
    length: float,
) -> NDArray[np.float64]:
    """The angular velocities [2, 3] at the ends with which a curve from quaternion a [4] to b [4] comes nearest to those inside [n, 4].

    What is left of a quaternion q is the vector part of q times the inverse of the wanted one, which is linear in the velocities.
    """
    b = facing(a, b)
    inverse = facing(a + weights[0] * (b - a), inside) * [-1, -1, -1, 1]
    between = product(b, a * [-1, -1, -1, 1])
    sine = float(np.linalg.norm(between[:3]))
    straight = between[:3] * (2 * np.arctan2(sine, between[3]) / sine / length if sine > 0 else 0.0)
    blocks = [0.5 * weight[..., None] * turning(product(end, inverse)) for weight, end in zip(weights[1:], (a, b), strict=True)]
    system = np.concatenate(blocks, axis=-1)  # [n, 3, 6]
    rest = -product(a + weights[0] * (b - a), inverse)[:, :3] - system @ np.tile(straight, 2)
    found = np.linalg.lstsq(system.reshape(-1, 6), rest.ravel(), rcond=None)[0]
    return np.asarray(straight + found.reshape(2, 3))


def turning(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrices [n, 3, 3] that take a vector v to the vector part of (v, 0) times quaternions [n, 4]."""
    x, y, z, w = quaternions.T
    return np.moveaxis(np.array([[w, z, -y], [-z, w, x], [y, -x, w]]), -1, 0)
