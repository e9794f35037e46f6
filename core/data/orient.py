"""Orients a capture of photographs: z up, the point that the cameras look at in the origin, at a scale that suits Blender.

Structure from motion finds camera poses up to a similarity, so that the up direction and the scale of its world are arbitrary.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import Camera
from .coverage import median_depth
from .dataset import Source, StatedBox, focus
from .training_box import DISTANCE, FORWARD, look_inward, panoramic

SURROUND = 2.0  # distance of what panoramas show, in the largest distance of one from their mean position, where there are no points
AGREE = 0.5  # the cameras' up directions are used if the mean of these unit vectors is longer than this


def orient(source: Source) -> tuple[Source, NDArray[Any]]:
    """The source moved to a world with z up and the point that the cameras look at in the origin; and the similarity [4, 4] from the old
    world to the new one.

    The median distance to that point becomes DISTANCE, or to what is in view, where the cameras look outwards.
    +y is the mean view direction, or the first camera's where the cameras surround the scene. Raises SnergError when all photographs
    were taken from one place.
    """
    cameras = tuple(view.camera for view in source.views)
    centre = looked_at(cameras, source.points, source.bounds)
    positions = np.stack([c.position for c in cameras])
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=-1).max())
    distance = float(np.median(np.linalg.norm(positions - centre, axis=-1)))
    if panoramic(cameras):
        distance = SURROUND * spread
        if source.points is not None and len(source.points):
            distance = float(np.median(np.linalg.norm(source.points - centre, axis=-1)))
    if not (np.isfinite(centre).all() and spread > 1e-9 * max(distance, 1e-9) and distance > 0):
        raise SnergError(f"All photographs of {source.root} were taken from one place; depth needs several places.")
    if not panoramic(cameras) and not look_inward(cameras, centre):
        distance = view_depth(cameras, source.points, source.bounds) or max(distance, spread)
    rotation = upright(upward(cameras) if source.up is None else source.up, np.stack([-c.camera_to_world[:3, 2] for c in cameras]))
    similarity = np.eye(4)
    similarity[:3, :3] = rotation * (DISTANCE / distance)
    similarity[:3, 3] = -similarity[:3, :3] @ centre
    scale = DISTANCE / distance
    moved = replace(
        source,
        views=tuple(replace(view, camera=view.camera.moved(similarity)) for view in source.views),
        points=None if source.points is None else source.points @ similarity[:3, :3].T + similarity[:3, 3],
        bounds=None if source.bounds is None else source.bounds * scale,
        stated=None if source.stated is None else moved_cube(source.stated, similarity),
    )
    return moved, similarity


def view_depth(cameras: Sequence[Camera], points: NDArray[Any] | None, bounds: NDArray[Any] | None) -> float | None:
    """The median depth of what is in view, world units, from points [N, 3] or bounds [V, 2]; None without both."""
    depth = median_depth(cameras, points) if points is not None else None
    if depth is None and bounds is not None:
        return float(2 / (1 / np.median(bounds, axis=0)).sum())
    return depth


def moved_cube(stated: StatedBox, similarity: NDArray[Any]) -> StatedBox:
    """A cube moved by a similarity [4, 4]. It stays axis-aligned: only its centre and size say something of the scene."""
    centre = similarity[:3, :3] @ stated.box.box_to_world[:3, 3] + similarity[:3, 3]
    half = stated.box.size / 2 * float(np.cbrt(np.linalg.det(similarity[:3, :3])))
    return replace(stated, box=Box.axis_aligned(centre - half, centre + half))


def upward(cameras: Sequence[Camera]) -> NDArray[Any]:
    """The up direction, a unit vector [3].

    Photographers hold cameras level, so that up is the direction most nearly perpendicular to all cameras' x axes, with the sign of
    the cameras' mean up. The mean itself would be tilted where the cameras do not surround the scene; it is used where the x axes are
    all alike. Where the cameras' up directions disagree, up is the direction of least variance of their positions, with the sign that
    lets the cameras look down.
    """
    right, ups, back = (np.stack([c.camera_to_world[:3, i] for c in cameras]) for i in range(3))
    mean = ups.mean(axis=0)
    if np.linalg.norm(mean) < AGREE:
        positions = np.stack([c.position for c in cameras])
        flat = np.linalg.eigh(np.cov(positions.T))[1][:, 0]
        side = flat @ back.mean(axis=0) or flat @ mean
        return np.asarray(flat if side >= 0 else -flat)
    mean /= np.linalg.norm(mean)
    weights, up = np.ones(len(right)), mean
    for _ in range(10):  # reweighted least squares: a few images that were rotated have little weight
        spread, axes = np.linalg.eigh((right * weights[:, None]).T @ right / weights.sum())
        if spread[1] < 0.05:
            return np.asarray(mean)
        up = axes[:, 0] * (1 if axes[:, 0] @ mean >= 0 else -1)
        weights = 1 / (np.abs(right @ up) + 0.05)
    return np.asarray(up if up @ mean > 0.6 else mean)


def upright(up: NDArray[Any], axes: NDArray[Any]) -> NDArray[Any]:
    """The rotation [3, 3] that takes `up` to z and the horizontal part of the mean of the view directions `axes` [N, 3] to +y."""
    level = axes - np.outer(axes @ up, up)
    mean = level.mean(axis=0)
    ahead = mean if np.linalg.norm(mean) > 0.3 else level[np.argmax(np.linalg.norm(level, axis=-1) > 0.3)]
    if np.linalg.norm(ahead) < 1e-3:  # straight down
        ahead = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up])


def looked_at(cameras: tuple[Camera, ...], points: NDArray[Any] | None, bounds: NDArray[Any] | None) -> NDArray[Any]:
    """The point [3] that the cameras look at, float64, in world units.

    points: [N, 3] of the scene; bounds: [V, 2], nearest and farthest depth in each view; None where the dataset has none.
    For forward-facing cameras the point lies on their mean optical axis, at a depth from their mean position: the median depth of the
    points in front of it; without such points, the depth whose disparity (1 / depth) is the mean disparity of the median bounds.
    For panoramas it is the median of their positions. For other cameras, and with neither points nor bounds, it is the point nearest to
    their optical axes (see `focus`).
    """
    if panoramic(cameras):
        return np.asarray(np.median([c.position for c in cameras], axis=0))
    axes = np.stack([-c.camera_to_world[:3, 2] for c in cameras])
    mean = axes.mean(axis=0)
    if np.linalg.norm(mean) < FORWARD or (points is None and bounds is None):
        return focus(cameras)[0]
    mean /= np.linalg.norm(mean)
    position = np.mean([c.position for c in cameras], axis=0)
    if points is not None and ((points - position) @ mean > 0).any():
        depth = (points - position) @ mean
        return np.asarray(position + mean * np.median(depth[depth > 0]))
    if bounds is None:
        return focus(cameras)[0]
    near, far = np.median(bounds, axis=0)
    return np.asarray(position + mean * (2 / (1 / near + 1 / far)))
