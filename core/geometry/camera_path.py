"""The path of a camera through time: keys at frames, interpolated between them; a change of camera is a cut.

The web viewer interpolates by the same rules (viewer/src/viewer/path.ts). docs/file-format.md describes the file.
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
from .rotation import quaternion, rotation_matrix, slerp

FORMAT = "snerg-path"
DIGITS = 12  # of each number in a file: a millionth of a unit at a million units from the origin
MAX_KEYS = 100_000  # of a path: an hour at 24 frames a second has 86,400 frames
MAX_FRAME = 1_048_574  # Blender's last frame
TOLERANCE = 0.25  # pixels by which a thinned path may show a point elsewhere
STILL = 1e-3  # pixels by which a camera that stands still may move: rounding of Blender's float32 matrices
LENSES = ("perspective", "orthographic")  # what can be interpolated, and what a page can draw

# A state holds what is interpolated: the point that the camera turns around (3), rotation (4), logarithms of the focal lengths (2),
# centre (2), near, 1 / far, and the distance from that point.
TARGET, ROTATION, FOCAL, CENTRE, NEAR, FAR, DISTANCE = slice(0, 3), slice(3, 7), slice(7, 9), slice(9, 11), 11, 12, 13


@dataclass(frozen=True, eq=False)
class Shot:
    """What one camera shows, until the next shot begins. Raises SnergError where its keys do not belong together."""

    frames: tuple[float, ...]  # of the keys, each later than the one before
    cameras: tuple[Camera, ...]  # of the keys: of one projection and one size
    distances: tuple[float, ...] = ()  # how far before each camera lies the point that it turns around; 0, or none at all: it is the camera

    def __post_init__(self) -> None:
        first = self.cameras[0] if self.cameras else None
        if first is None or len(self.frames) != len(self.cameras):
            raise SnergError("A shot of a camera path needs a key, and each key a frame and a camera; write the path again.")
        if not self.distances:
            object.__setattr__(self, "distances", (0.0,) * len(self.frames))
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
        part = (frame - self.frames[index]) / (self.frames[index + 1] - self.frames[index])
        one, other = (state_of(self.cameras[i], self.distances[i]) for i in (index, index + 1))
        state = blended(one, other, np.array([part]))[0]
        return camera_of(state, self.cameras[index])


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
        scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
        shots = [
            Shot(shot.frames, tuple(c.moved(similarity) for c in shot.cameras), tuple(scale * d for d in shot.distances))
            for shot in self.shots
        ]
        return CameraPath(tuple(shots), self.start, self.end, self.fps)

    def to_json(self) -> dict[str, Any]:
        """The path as JSON values, for `from_json`."""
        first = self.shots[0].cameras[0]
        head = {"format": FORMAT, "version": 1, "fps": self.fps, "start": self.start, "end": self.end}
        return {**head, "width": first.width, "height": first.height, "shots": [shot_json(shot) for shot in self.shots]}

    @classmethod
    def from_json(cls, value: Any) -> CameraPath:
        """A path from the result of `to_json`. Raises SnergError when a value is missing or out of range."""
        try:
            if value.get("version") != 1:
                raise SnergError(f"The camera path has version {value.get('version')} of the format, and this program reads version 1.")
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
    for frame, camera, distance in zip(shot.frames, shot.cameras, shot.distances, strict=True):
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
        last = values
    return {"name": first.name, "projection": first.projection, "keys": keys}


def _short(values: Sequence[float] | NDArray[np.float64]) -> list[float]:
    return [float(f"{value:.{DIGITS}g}") for value in values]


def shot_from_json(value: Any, size: tuple[int, int]) -> Shot:
    """A shot from the result of `shot_json`; near and distance (0), far (none) and centre (the middle) may be missing.

    Raises as `schema` and `Camera` do.
    """
    name, projection = schema.text(value["name"], "name"), schema.text(value["projection"], "projection")
    now: dict[str, Any] = {"near": 0.0, "far": None, "distance": 0.0, "centre": [size[0] / 2, size[1] / 2]}
    frames, cameras, distances = [], [], []
    for key in value["keys"][: MAX_KEYS + 1]:
        now = {**now, **schema.record(key, "a key")}
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
    return Shot(tuple(frames), tuple(cameras), tuple(distances))


def path_bytes(path: CameraPath) -> bytes:
    """The file of a path, UTF-8: one key a line."""
    text = json.dumps(path.to_json(), allow_nan=False, separators=(",", ":"))
    return (text.replace('{"frame"', '\n{"frame"') + "\n").encode()


def state_of(camera: Camera, distance: float) -> NDArray[np.float64]:
    """The state [14] of a camera that turns around a point so far before it; see TARGET and the constants beside it."""
    rotation = camera.camera_to_world[:3, :3]
    lens = np.log(camera.focal), camera.centre, [camera.near, 1 / camera.far, distance]
    return np.concatenate([camera.position - distance * rotation[:, 2], quaternion(rotation), *lens])


def camera_of(state: NDArray[np.float64], like: Camera) -> Camera:
    """The camera of a state [14], with the name, size and projection of `like`."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_matrix(state[ROTATION]), positions(state[None])[0]
    focal, centre = np.exp(state[FOCAL]), state[CENTRE]
    lens = (float(focal[0]), float(focal[1])), (float(centre[0]), float(centre[1]))
    far = 1 / float(state[FAR]) if state[FAR] > 0 else math.inf
    return Camera(like.width, like.height, *lens, pose, like.projection, like.name, float(state[NEAR]), None, far)


def positions(states: NDArray[np.float64]) -> NDArray[np.float64]:
    """The positions [N, 3] of the cameras of states [N, 14]: behind the points that they turn around."""
    x, y, z, w = states[:, ROTATION].T
    backward = np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=-1)
    return np.asarray(states[:, TARGET] + states[:, DISTANCE, None] * backward)


def blended(a: NDArray[np.float64], b: NDArray[np.float64], parts: NDArray[np.float64]) -> NDArray[np.float64]:
    """States [N, 14] between a [14] (part 0) and b [14] (part 1): rotations spherically and the shorter way, all else linearly."""
    states = a + (b - a) * parts[:, None]
    states[:, ROTATION] = slerp(a[ROTATION], b[ROTATION], parts)
    return np.asarray(states)


def pixel_errors(
    a: NDArray[np.float64], b: NDArray[np.float64], like: Camera, depths: NDArray[np.float64]
) -> NDArray[np.float64]:  # fmt: skip
    """By how many pixels [N] pictures of states a [N, 14] show points elsewhere than those of states b [N, 14], at most.

    The points lie in a's pictures: at their corners, edges and middle, nearest, farthest and between. like: gives the pictures' size and
    projection. depths: [N, 2], those of the nearest and the farthest point shown, along the view axis. A clip plane that is off by a part
    of its distance counts as an angle of as many radians.
    """
    flat = np.stack(np.meshgrid([0, like.width / 2, like.width], [0, like.height / 2, like.height]), axis=-1).reshape(-1, 2)
    depth = np.stack([depths[:, 0], np.sqrt(depths.prod(axis=-1)), depths[:, 1]], axis=-1)[:, :, None]  # [N, 3, 1]
    focal_a, focal_b = np.exp(a[:, None, None, FOCAL]), np.exp(b[:, None, None, FOCAL])
    scale = np.ones_like(depth[..., None]) if like.projection == "orthographic" else depth[..., None]
    across = (flat - a[:, None, None, CENTRE]) / focal_a * scale * [1, -1]  # [N, 3, 9, 2]
    local = np.concatenate([across, -np.broadcast_to(depth[..., None], (*across.shape[:-1], 1))], axis=-1)
    turn_a, turn_b = (np.array([rotation_matrix(q) for q in states[:, ROTATION]]) for states in (a, b))
    offset = np.einsum("nij,nabj->nabi", turn_a, local) + (positions(a) - positions(b))[:, None, None]
    there = np.einsum("nji,nabj->nabi", turn_b, offset)
    behind = there[..., 2] >= 0 if like.projection == "perspective" else np.zeros(there.shape[:-1], bool)
    scale = np.where(behind, 1.0, -there[..., 2])[..., None] if like.projection == "perspective" else np.ones_like(there[..., :1])
    shown = there[..., :2] * [1, -1] / scale * focal_b + b[:, None, None, CENTRE]
    moved = np.where(behind, np.inf, np.linalg.norm(shown - flat, axis=-1)).max(axis=(1, 2))
    clipped = np.abs(a[:, NEAR] - b[:, NEAR]) / np.maximum(a[:, NEAR], depths[:, 0]) + np.abs(a[:, FAR] - b[:, FAR]) * depths[:, 1]
    return np.asarray(moved + np.exp(a[:, FOCAL]).max(axis=-1) * clipped)


def thinned(shot: Shot, depths: NDArray[np.float64], centre: NDArray[np.float64], tolerance: float = TOLERANCE) -> Shot:
    """The shot with as few keys as found that keep every one of its cameras within `tolerance` pixels.

    depths: [keys, 2], as in `pixel_errors`. centre: [3] of what is shown.
    The camera turns around itself, around `centre`, or around the point that it looks at most of the time: whatever needs fewer keys.
    """
    found = [_thinned(Shot(shot.frames, shot.cameras), depths, tolerance)]
    if len(found[0].frames) > 2:
        axes = np.array([camera.camera_to_world[:3, 2] for camera in shot.cameras])
        places = np.array([camera.position for camera in shot.cameras])
        for point in (centre, looked_at(places, axes)):
            distances = np.maximum(((places - point) * axes).sum(axis=-1), 0.0)
            found.append(_thinned(Shot(shot.frames, shot.cameras, tuple(map(float, distances))), depths, tolerance))
    return min(found, key=lambda one: len(one.frames))


def looked_at(places: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The point [3] that is nearest, by least squares, to the view axes of cameras at places [N, 3] with unit axes [N, 3]."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = places.mean(axis=0)  # far from the origin, differences are taken first
    offset = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, places - middle), rcond=1e-6)[0]
    return np.asarray(middle + offset)


def _thinned(shot: Shot, depths: NDArray[np.float64], tolerance: float) -> Shot:
    """Douglas and Peucker's algorithm: a part that is not within the tolerance is parted at its worst frame."""
    states = np.array([state_of(camera, distance) for camera, distance in zip(shot.cameras, shot.distances, strict=True)])
    frames, like = np.array(shot.frames, np.float64), shot.cameras[0]
    kept, parts = {0, len(frames) - 1}, [(0, len(frames) - 1)]
    while parts:
        first, last = parts.pop()
        if last - first < 2:
            continue
        inside = slice(first + 1, last)
        guess = blended(states[first], states[last], (frames[inside] - frames[first]) / (frames[last] - frames[first]))
        errors = pixel_errors(states[inside], guess, like, depths[inside])
        worst = int(np.argmax(errors))
        if errors[worst] > tolerance:
            middle = first + 1 + worst
            kept.add(middle)
            parts += [(first, middle), (middle, last)]
    chosen = sorted(kept)
    if len(chosen) == 2 and pixel_errors(states[:1], states[-1:], like, depths[:1])[0] <= STILL:
        chosen = chosen[:1]
    return Shot(tuple(shot.frames[i] for i in chosen), tuple(shot.cameras[i] for i in chosen), tuple(shot.distances[i] for i in chosen))
