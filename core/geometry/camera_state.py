"""The states between which a camera path interpolates, linearly or along a cubic curve, and how far apart two of them look.

The web viewer interpolates by the same rules (viewer/src/optional/path/path.ts). docs/file-format.md describes them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .rotation import product, quaternion, rotation_matrices, rotation_matrix, slerp

# A state holds what is interpolated: the point that the camera turns around (3), rotation (4), logarithms of the focal lengths (2),
# centre (2), near, 1 / far, and the distance from that point.
TARGET, ROTATION, FOCAL, CENTRE, NEAR, FAR, DISTANCE = slice(0, 3), slice(3, 7), slice(7, 9), slice(9, 11), 11, 12, 13
# A curve [2, 11] holds the velocities, a frame, with which a part of a path leaves its first state and reaches its last: of PLAIN's values
# of the state, and TURN, the angular velocity in radians about the world's axes.
CURVE = 11
PLAIN = (0, 1, 2, 7, 8, 9, 10, 13)  # of a state
PLAIN_OF_CURVE = (0, 1, 2, 6, 7, 8, 9, 10)
TURN = slice(3, 6)  # of a curve
LONGEST_LENS = 50.0  # logarithm of a focal length, at most: a curve of a damaged file does not overflow
NO_ROTATION = 1e-6  # length of a quaternion below which it says nothing


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


def hermite(parts: NDArray[np.float64], length: float) -> tuple[NDArray[np.float64], ...]:
    """The weights [N, 1] of cubic Hermite interpolation over `length` frames: of the last value (the first has the rest to 1), and of the
    velocities at the first and at the last."""
    u = parts[:, None]
    return u * u * (3 - 2 * u), length * u * (1 - u) ** 2, -length * u * u * (1 - u)


def curved(
    a: NDArray[np.float64], b: NDArray[np.float64], curve: NDArray[np.float64], length: float, parts: NDArray[np.float64]
) -> NDArray[np.float64]:  # fmt: skip
    """States [N, 14] between a [14] and b [14], which are `length` frames apart, along a curve [2, 11].

    Cubic Hermite interpolation, of rotations as in glTF: of quaternions, whose length then becomes 1. Near and far go linearly.
    """
    states = a + (b - a) * parts[:, None]
    last, leaving, reaching = hermite(parts, length)
    plain, mine = list(PLAIN), list(PLAIN_OF_CURVE)
    states[:, plain] = a[plain] + last * (b - a)[plain] + leaving * curve[0, mine] + reaching * curve[1, mine]
    states[:, FOCAL] = states[:, FOCAL].clip(-LONGEST_LENS, LONGEST_LENS)
    one, other = a[ROTATION], facing(a[ROTATION], b[ROTATION])
    turns = one + last * (other - one) + leaving * spin(curve[0, TURN], one) + reaching * spin(curve[1, TURN], other)
    size = np.linalg.norm(turns, axis=-1, keepdims=True)
    states[:, ROTATION] = np.where(size > NO_ROTATION, turns / np.maximum(size, NO_ROTATION), one)
    return np.asarray(states)


def facing(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """b [..., 4], or the same rotation as -b, which is nearer to the quaternions a [..., 4]."""
    return np.where((a * b).sum(axis=-1, keepdims=True) < 0, -b, b)


def spin(velocity: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """The velocity [4] of a quaternion [4] that turns with an angular velocity [3] about the world's axes."""
    return np.asarray(0.5 * product(np.append(velocity, 0.0), turn))


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
    turn_a, turn_b = (rotation_matrices(states[:, ROTATION]) for states in (a, b))
    offset = np.einsum("nij,nabj->nabi", turn_a, local) + (positions(a) - positions(b))[:, None, None]
    there = np.einsum("nji,nabj->nabi", turn_b, offset)
    behind = there[..., 2] >= 0 if like.projection == "perspective" else np.zeros(there.shape[:-1], bool)
    scale = np.where(behind, 1.0, -there[..., 2])[..., None] if like.projection == "perspective" else np.ones_like(there[..., :1])
    shown = there[..., :2] * [1, -1] / scale * focal_b + b[:, None, None, CENTRE]
    moved = np.where(behind, np.inf, np.linalg.norm(shown - flat, axis=-1)).max(axis=(1, 2))
    clipped = np.abs(a[:, NEAR] - b[:, NEAR]) / np.maximum(a[:, NEAR], depths[:, 0]) + np.abs(a[:, FAR] - b[:, FAR]) * depths[:, 1]
    return np.asarray(moved + np.exp(a[:, FOCAL]).max(axis=-1) * clipped)
