"""The path of a camera through time: keys at frames, interpolated between them (camera_state.py); a change of camera is a cut.

docs/file-format.md describes the file.
"""

from __future__ import annotations

import bisect
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io import schema
from ..io.guard import why
from .camera import Camera
from .camera_state import CURVE, blended, camera_of, curved, state_of
from .rotation import quaternion, rotation_matrix

FORMAT = "snerg-path"
DIGITS = 12  # of each number in a file: a millionth of a unit at a million units from the origin
MAX_KEYS = 100_000  # of a path: an hour at 24 frames a second has 86,400 frames
MAX_FRAME = 1_048_574  # Blender's last frame
CURVE_DIGITS = 7  # of the velocities of a curve: a thousandth of a pixel over ten thousand pixels
VERSIONS = (1, 2)  # of the format; only the second has curves
LENSES = ("perspective", "orthographic")  # what can be interpolated, and what a page can draw


@dataclass(frozen=True, eq=False)
class Shot:
    """What one camera shows, until the next shot begins. Raises SnergError where its keys do not belong together."""

    frames: tuple[float, ...]  # of the keys, each later than the one before
    cameras: tuple[Camera, ...]  # of the keys: of one projection and one size
    distances: tuple[float, ...] = ()  # how far before each camera lies the point that it turns around; 0, or none at all: it is the camera
    curves: tuple[NDArray[np.float64] | None, ...] = ()  # from each key to the next: [2, 11], see camera_state.py; None, or none: linear

    def __post_init__(self) -> None:
        first = self.cameras[0] if self.cameras else None
        if first is None or len(self.frames) != len(self.cameras):
            raise SnergError("A shot of a camera path needs a key, and each key a frame and a camera; write the path again.")
        if not self.distances:
            object.__setattr__(self, "distances", (0.0,) * len(self.frames))
        if not self.curves:
            object.__setattr__(self, "curves", (None,) * (len(self.frames) - 1))
        if len(self.curves) != len(self.frames) - 1:
            raise SnergError(f"The keys of {first.name!r} need a curve, or none, to each next one; write the path again.")
        if len(self.distances) != len(self.frames) or not all(0 <= distance <= schema.FAR for distance in self.distances):
            raise SnergError(f"The keys of {first.name!r} need a distance each, not below 0; write the path again.")
        if any(later <= earlier for earlier, later in pairwise(self.frames)):
            raise SnergError(f"The keys of {first.name!r} are not in the order of their frames; write the path again.")
        if first.projection not in LENSES:
            raise SnergError(f"The camera {first.name!r} is {first.projection}; a path needs perspective or orthographic cameras.")
        if any((c.projection, c.width, c.height) != (first.projection, first.width, first.height) for c in self.cameras):
            raise SnergError(f"The keys of {first.name!r} differ in projection or size, which cannot change within a shot of a path.")

    def camera_at(self, frame: float) -> Camera:
        """The camera at a frame: interpolated between keys, and that of the first or last key before and after them."""
        index = bisect.bisect_right(self.frames, frame) - 1
        if index < 0 or index == len(self.frames) - 1:
            return self.cameras[max(index, 0)]
        length, curve = self.frames[index + 1] - self.frames[index], self.curves[index]
        parts = np.array([(frame - self.frames[index]) / length])
        one, other = (state_of(self.cameras[i], self.distances[i]) for i in (index, index + 1))
        states = blended(one, other, parts) if curve is None else curved(one, other, curve, length, parts)
        return camera_of(states[0], self.cameras[index])

    def moved(self, similarity: NDArray[np.float64]) -> Shot:
        """The shot transformed by a similarity [4, 4] to another world."""
        scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
        curves = [None if curve is None else moved_curve(curve, similarity[:3, :3] / scale, scale) for curve in self.curves]
        distances = tuple(scale * distance for distance in self.distances)
        return Shot(self.frames, tuple(camera.moved(similarity) for camera in self.cameras), distances, tuple(curves))


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Shots one after another, from frame `start` to frame `end`, which is still shown. Raises SnergError for values out of range."""

    shots: tuple[Shot, ...]  # each begins at its first key; the first one also covers what is before
    start: int
    end: int
    fps: float  # frames a second

    def __post_init__(self) -> None:
        if not (math.isfinite(self.fps) and 0 < self.fps <= 1000):
            raise SnergError(f"The camera path has {self.fps} frames a second; it must be above 0 and at most 1000.")
        if not -MAX_FRAME <= self.start <= self.end <= MAX_FRAME:
            raise SnergError(f"The camera path goes from frame {self.start} to {self.end}; the end must not be before the start.")
        if not self.shots or self.keys > MAX_KEYS:
            raise SnergError(f"The camera path has {self.keys} keys; it must have from 1 to {MAX_KEYS}.")
        begins = [shot.frames[0] for shot in self.shots]
        if any(later <= earlier for earlier, later in pairwise(begins)):
            raise SnergError("The shots of the camera path are not in the order of their frames; write the path again.")
        if len({(shot.cameras[0].width, shot.cameras[0].height) for shot in self.shots}) > 1:
            raise SnergError("The shots of the camera path differ in size; a path has pictures of one width and height.")

    @property
    def keys(self) -> int:
        """The number of keys of all shots."""
        return sum(len(shot.frames) for shot in self.shots)

    @property
    def frames(self) -> range:
        """The whole frames, from `start` to `end`."""
        return range(self.start, self.end + 1)

    @property
    def moves(self) -> bool:
        """Whether the path shows more than one view."""
        return self.keys > 1

    def camera_at(self, frame: float) -> Camera:
        """The camera of the shot that a frame belongs to, at that frame."""
        begins = [shot.frames[0] for shot in self.shots]
        return self.shots[max(bisect.bisect_right(begins, frame) - 1, 0)].camera_at(frame)

    def moved(self, similarity: NDArray[np.float64]) -> CameraPath:
        """The path transformed by a similarity [4, 4] to another world."""
        return CameraPath(tuple(shot.moved(similarity) for shot in self.shots), self.start, self.end, self.fps)

    def to_json(self) -> dict[str, Any]:
        """The path as JSON values, for `from_json`."""
        first = self.shots[0].cameras[0]
        version = 2 if any(curve is not None for shot in self.shots for curve in shot.curves) else 1
        head = {"format": FORMAT, "version": version, "fps": self.fps, "start": self.start, "end": self.end}
        return {**head, "width": first.width, "height": first.height, "shots": [shot_json(shot) for shot in self.shots]}

    @classmethod
    def from_json(cls, value: Any) -> CameraPath:
        """A path from the result of `to_json`. Raises SnergError when a value is missing or out of range."""
        try:
            if value.get("version") not in VERSIONS:
                raise SnergError(f"The camera path has version {value.get('version')} of the format; this program reads versions 1 and 2.")
            size = schema.whole(value["width"], "width", 1, 2**16), schema.whole(value["height"], "height", 1, 2**16)
            start, end = (schema.whole(value[name], name, -MAX_FRAME, MAX_FRAME) for name in ("start", "end"))
            shots = tuple(shot_from_json(shot, size) for shot in value["shots"])
            return cls(shots, start, end, schema.positive(value["fps"], "fps"))
        except SnergError:
            raise
        except Exception as error:  # whatever a value of another kind raises
            raise SnergError(f"The camera path is incomplete or damaged ({why(error)}); write it again.") from error


def shot_json(shot: Shot) -> dict[str, Any]:
    """A shot as JSON values. What a key leaves out is as in the key before it."""
    first = shot.cameras[0]
    keys: list[dict[str, Any]] = []
    last: dict[str, Any] = {}
    for frame, camera, distance, curve in zip(shot.frames, shot.cameras, shot.distances, (*shot.curves, None), strict=True):
        values: dict[str, Any] = {
            "position": _short(camera.position),
            "rotation": _short(quaternion(camera.camera_to_world[:3, :3])),
            "distance": _short([distance])[0],
            "focal": _short(camera.focal),
            "centre": _short(camera.centre),
            "near": _short([camera.near])[0],
            "far": _short([camera.far])[0] if math.isfinite(camera.far) else None,
        }
        keys.append({"frame": frame, **{name: item for name, item in values.items() if not last or item != last[name]}})
        if curve is not None:
            keys[-1]["curve"] = [_short(velocities, CURVE_DIGITS) for velocities in curve]
        last = values
    return {"name": first.name, "projection": first.projection, "keys": keys}


def _short(values: Sequence[float] | NDArray[np.float64], digits: int = DIGITS) -> list[float]:
    return [float(f"{value:.{digits}g}") for value in values]


def shot_from_json(value: Any, size: tuple[int, int]) -> Shot:
    """A shot from the result of `shot_json`; near and distance (0), far (none), centre (the middle) and curves may be missing.

    Raises as `schema` and `Camera` do.
    """
    name, projection = schema.text(value["name"], "name"), schema.text(value["projection"], "projection")
    now: dict[str, Any] = {"near": 0.0, "far": None, "distance": 0.0, "centre": [size[0] / 2, size[1] / 2]}
    frames, cameras, distances, curves = [], [], [], []
    for key in value["keys"][: MAX_KEYS + 1]:
        now = {**now, "curve": None, **schema.record(key, "a key")}
        frames.append(schema.number(now["frame"], "frame", -2 * MAX_FRAME, 2 * MAX_FRAME))
        pose = np.eye(4)
        pose[:3, 3] = schema.numbers(now["position"], "position", (3,))
        turn = schema.numbers(now["rotation"], "rotation", (4,))
        if not 1e-6 < np.linalg.norm(turn) < 1e6:
            raise ValueError("rotation is no quaternion")
        pose[:3, :3] = rotation_matrix(turn)
        focal, centre = (schema.numbers(now[item], item, (2,)) for item in ("focal", "centre"))
        far = math.inf if now["far"] is None else schema.positive(now["far"], "far")
        near = schema.number(now["near"], "near", 0.0)
        lens = (float(focal[0]), float(focal[1])), (float(centre[0]), float(centre[1]))
        distances.append(schema.number(now["distance"], "distance", 0.0))
        cameras.append(Camera(*size, *lens, pose, projection, name, near, None, far))
        curves.append(None if now["curve"] is None else schema.numbers(now["curve"], "curve", (2, CURVE)))
    if curves and curves.pop() is not None:
        raise ValueError("the last key of a shot has a curve to a next one")
    return Shot(tuple(frames), tuple(cameras), tuple(distances), tuple(curves))


def moved_curve(curve: NDArray[np.float64], rotation: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """A curve [2, 11] in another world, after a rotation [3, 3] and a scale."""
    point, turn, rest, distance = np.split(curve, [3, 6, 10], axis=-1)
    return np.hstack([scale * point @ rotation.T, turn @ rotation.T, rest, scale * distance])


def path_bytes(path: CameraPath) -> bytes:
    """The file of a path, UTF-8: one key a line."""
    text = json.dumps(path.to_json(), allow_nan=False, separators=(",", ":"))
    return (text.replace('{"frame"', '\n{"frame"') + "\n").encode()
