"""Finds the box to train in: from what a file states, the points, the depth bounds or the cameras, each measured before it is believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.box import Box
from ..geometry.camera import Camera
from .coverage import crossing, facing, median_depth
from .dataset import Source, focus, focus_box
from .parallax import points_by_parallax

DISTANCE = 4.0  # median distance in world units from a camera to what the cameras look at, as in NeRF-synthetic
FARTHEST = 2 * DISTANCE  # largest coordinate of the box, along each axis, where the cameras look at the origin
FRUSTUMS = (2.0, 98.0)  # percentiles of the frustums' corners between which the box spans
MARGIN = 0.05  # added to the box on each side, as a part of its span
FORWARD = 0.9  # the cameras are forward-facing if the mean of their unit view directions is longer than this
INWARD = 0.5  # the cameras look at a centre if the mean cosine of their angles to it is above this
CROSSED = 0.9  # share of the rays that must cross a box of points; of fewer, the points cover a part of what the pictures show
KEPT = 0.7  # share of the points that must lie in their box; where fewer do, the others are a background and no outliers
SURROUND = 1.5  # half the side of a cube around cameras in a room, relative to the median depth of the points in view
STATED_CROSSED = 0.3  # share of the rays that must cross a box that a file states: an object in front of nothing needs no more
LEAST_POINTS = 10  # that say anything of the scene
APART = ((64, 32, 16, 8), 0.7, 4, 1e-4)  # see `together`: grids tried, share of points to keep, and neighbours: at least, share
PARALLAX = (3.0, 97.0)  # percentiles of the points found by parallax, of which some are wrong, between which the box spans
LEAST_PATCHES = 50  # found by parallax that say where the walls are
OUTWARD = 8.0  # half the box's side relative to the cameras' spread, where they look outwards and nothing says how far they see


@dataclass(frozen=True, eq=False)
class TrainingBox:
    """A box to train in, and how it was found."""

    box: Box | None  # None for the cube of the views (see `focus_box`), which renders without any other have
    origin: str  # a sentence or two: where it comes from, and what was repaired
    opaque: Box | None = None  # in its place where pictures have neither alpha nor a plain backdrop: it holds the surroundings as well


def training_box(source: Source, pictures: bool = True) -> TrainingBox:
    """The box that training must explain, axis-aligned, in the source's world, which is oriented where it is of photographs.

    A box that the file gives as ours is taken as it is. A cube that another tool states is taken where rays cross it and it is not
    much larger than what the cameras show; a larger one is only an upper bound, as instant-ngp skips empty space at any size.
    pictures: whether the pictures may be read where nothing else says how far the cameras see.
    """
    if source.box is not None:
        return TrainingBox(source.box, "The file gives it (snerg_box).")
    measured = measured_box(source, pictures)
    if source.stated is None:
        return measured
    cameras = [view.camera for view in source.views]
    stated, key = source.stated.box, source.stated.key
    share = crossing(stated, cameras)
    if share < STATED_CROSSED:
        text = f"Only {100 * share:.0f} % of the rays cross the box that the file states ({key}), so that another is measured."
        return replace(measured, origin=f"{text} {measured.origin}")
    if stated.size.max() / 2 <= FARTHEST and measured.opaque is None:
        return TrainingBox(stated, f"The file states it ({key}).")
    box = _within(measured.box or focus_box(tuple(cameras)), stated)
    opaque = None if measured.opaque is None else _within(measured.opaque, stated)
    return TrainingBox(box, f"{measured.origin} The file states a larger one ({key}), an upper bound.", opaque)


def _within(box: Box, bound: Box) -> Box:
    """The part of a box inside a larger one, both axis-aligned; the box itself where they do not meet."""
    low, high = (
        np.maximum(box.corners().min(axis=0), bound.corners().min(axis=0)),
        np.minimum(box.corners().max(axis=0), bound.corners().max(axis=0)),
    )
    return Box.axis_aligned(low, high) if (low < high).all() else box


def measured_box(source: Source, pictures: bool) -> TrainingBox:
    """The box that a capture itself shows. pictures: see `training_box`."""
    cameras = tuple(view.camera for view in source.views)
    inward = look_inward(cameras, np.zeros(3) if source.photographs else focus(cameras)[0])
    if inward and not source.photographs:
        return _renders_box(cameras)
    if source.points is not None and len(source.points) >= LEAST_POINTS:
        found = _points_box(cameras, source.points, inward)
        if found is not None:
            return found
    if source.bounds is not None:
        return _frustums_box(cameras, source.bounds, inward)
    return TrainingBox(_cube(cameras), _CUBE) if inward else _outward_box(source, pictures)


def _renders_box(cameras: tuple[Camera, ...]) -> TrainingBox:
    """The box of renders whose cameras look at a centre; `opaque` is None for one camera, which says nothing of the distance."""
    origin = "It is a cube around the point that the cameras look at, as wide as their pictures are there"
    centre = focus(cameras)[0]
    distance = 1.5 * float(np.percentile([np.linalg.norm(c.position - centre) for c in cameras], 90))
    if len(cameras) < 2 or not (np.isfinite(distance) and distance > 0):
        return TrainingBox(None, f"{origin}.")
    half = np.maximum(focus_box(cameras).size / 2, distance)
    wide = Box.axis_aligned(centre - half, centre + half)
    return TrainingBox(None, f"{origin}, or one that holds most cameras, where pictures have neither alpha nor a plain backdrop.", wide)


_CUBE = "It is a cube around the point that the cameras look at, which holds most cameras."


def look_inward(cameras: tuple[Camera, ...], centre: NDArray[Any]) -> bool:
    """Whether the cameras look at a centre [3], or all in one direction; not from the inside of a room to its walls."""
    mean = np.mean([-c.camera_to_world[:3, 2] for c in cameras], axis=0)
    return not panoramic(cameras) and bool(np.linalg.norm(mean) > FORWARD or facing(cameras, centre) > INWARD)


def panoramic(cameras: Sequence[Camera]) -> bool:
    """Whether most cameras are panoramas, whose view axis says nothing: the scene is all around them."""
    return sum(camera.projection == "equirectangular" for camera in cameras) * 2 > len(cameras)


def _cube(cameras: tuple[Camera, ...]) -> Box:
    """The cube around the origin with 1.5 times the distance of most cameras as its half side, at most FARTHEST."""
    half = np.full(3, min(1.5 * float(np.percentile([np.linalg.norm(c.position) for c in cameras], 90)), FARTHEST))
    return Box.axis_aligned(-half, half)


def _outward_box(source: Source, pictures: bool) -> TrainingBox:
    """The box for cameras that look outward, without points or depth: from the pictures' own parallax, else a cube around the cameras."""
    positions = np.stack([view.camera.position for view in source.views])
    middle = positions.mean(axis=0)
    spread = float(np.percentile(np.linalg.norm(positions - middle, axis=-1), 90))
    legible = pictures and spread > 0 and not panoramic([view.camera for view in source.views])
    points = points_by_parallax(source.views, spread) if legible else np.zeros((0, 3))
    if len(points) >= LEAST_PATCHES:
        corners = np.concatenate([np.percentile(points, PARALLAX, axis=0), positions])
        box = Box.axis_aligned(*_grown(corners.min(axis=0), corners.max(axis=0)))
        return TrainingBox(
            box, f"The cameras look outward, and there are no points: it spans {len(points)} patches that pictures agree on."
        )
    half = OUTWARD * (spread or 1.0)
    origin = (
        f"The cameras look outward, and neither points nor the pictures say how far away what they show is: it is a cube around them, "
        f"{OUTWARD:g} times as wide as their spread. Give points, or a box (snerg_box), where the scene is larger or smaller than that."
    )
    return TrainingBox(Box.axis_aligned(middle - half, middle + half), origin)


def _limits(cameras: tuple[Camera, ...], depth: float, inward: bool) -> tuple[NDArray[Any], NDArray[Any]]:
    """(lowest [3], highest [3] coordinates) of a box from points or bounds: as far around the cameras as they see.

    depth: the median of what is in view, world units.
    """
    positions = np.stack([c.position for c in cameras])
    around = min(depth, DISTANCE) if inward else 2 * depth
    low, high = positions.min(axis=0) - around, positions.max(axis=0) + around
    return (np.minimum(low, -FARTHEST), np.maximum(high, FARTHEST)) if inward else (low, high)


def _points_box(cameras: tuple[Camera, ...], points: NDArray[Any], inward: bool) -> TrainingBox | None:
    """The box of the points without those that lie apart, and of what else the pictures show; None when the points say nothing."""
    depth = median_depth(cameras, points)
    if depth is None:
        return None
    low, high = _limits(cameras, depth, inward)
    near = points[((points >= low) & (points <= high)).all(axis=-1)]
    if len(near) < LEAST_POINTS:
        return None
    kept = near[together(near, low, high)]
    first, last = _grown(kept.min(axis=0), kept.max(axis=0))
    box, apart = Box.axis_aligned(first, last), len(points) - len(kept)
    origin = f"It spans {len(kept)} of {len(points)} points; the others lie apart." if apart else f"It spans the {len(points)} points."
    share = crossing(box, cameras)
    if share >= CROSSED and len(kept) >= KEPT * len(points):
        return TrainingBox(_holding(box, _looked_at_cube(cameras)) if inward else box, origin)
    part = (
        f"The points lie on a part of what the pictures show: {100 * share:.0f} % of the rays cross the box of {len(kept)} of "
        f"{len(points)} points. "
    )
    if inward:
        return TrainingBox(_holding(box, _cube(cameras)), f"{part}So it also holds the cube around what the cameras look at.")
    around = np.mean([c.position for c in cameras], axis=0)
    cube = Box.axis_aligned(around - SURROUND * depth, around + SURROUND * depth)
    return TrainingBox(_holding(box, cube), f"{part}So it reaches as far on all sides of the cameras.")


def _holding(box: Box, other: Box) -> Box:
    """The smallest axis-aligned box that holds both."""
    corners = np.concatenate([box.corners(), other.corners()])
    return Box.axis_aligned(corners.min(axis=0), corners.max(axis=0))


def _looked_at_cube(cameras: tuple[Camera, ...]) -> Box:
    """The largest cube around the origin that all pictures hold across: what the cameras look at may have parts without points."""
    halves = []
    for camera in cameras:
        distance = 1.0 if camera.projection == "orthographic" else float(np.linalg.norm(camera.position))
        halves.append(min(camera.width / camera.focal[0], camera.height / camera.focal[1]) / 2 * distance)
    half = np.full(3, min(float(np.median(halves)) / 2**0.5, FARTHEST))
    return Box.axis_aligned(-half, half)


def _frustums_box(cameras: tuple[Camera, ...], bounds: NDArray[Any], inward: bool) -> TrainingBox:
    """The box of the cameras' frustums between their nearest and farthest depths `bounds` [V, 2]."""
    depth = float(2 / (1 / np.median(bounds, axis=0)).sum())
    low, high = (np.full(3, -FARTHEST), np.full(3, FARTHEST)) if inward else _limits(cameras, depth, inward)
    corners = np.concatenate([frustum(c, *b) for c, b in zip(cameras, bounds, strict=True)])
    found = _grown(*np.percentile(corners.clip(low, high), FRUSTUMS, axis=0))
    return TrainingBox(Box.axis_aligned(*found), "It spans the cameras' views between the depths that the file gives.")


def _grown(low: NDArray[Any], high: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The corners [3] of a box with a margin."""
    grow = np.maximum(MARGIN * (high - low), 0.02 * (high - low).max() + 1e-6)
    return low - grow, high + grow


def together(points: NDArray[Any], low: NDArray[Any], high: NDArray[Any]) -> NDArray[Any]:
    """Which points [N, 3] have neighbours, bool [N]; the others are outliers of structure from motion.

    low, high: [3], between which all points lie. Not percentiles: a part of the scene with little texture has few points, but they lie
    side by side. Points are counted in the cells of a grid and the 26 around each; the finest grid is used in which most points have
    neighbours, so that sparse clouds are kept as well.
    """
    grids, share, least, part = APART
    wanted = max(least, part * len(points))
    keep = np.ones(len(points), bool)
    for cells in grids:
        index = np.clip((points - low) / (high - low).max() * cells, 0, cells - 1).astype(int) + 1
        counts = np.zeros((cells + 2,) * 3, int)
        np.add.at(counts, tuple(index.T), 1)
        for axis in range(3):
            counts = counts + np.roll(counts, 1, axis) + np.roll(counts, -1, axis)
        keep = counts[tuple(index.T)] >= wanted
        if keep.mean() >= share:
            return np.asarray(keep)
    return np.asarray(keep) if keep.any() else np.ones(len(points), bool)


def frustum(camera: Camera, near: float, far: float) -> NDArray[Any]:
    """The corners [8, 3] of a camera's frustum between two depths, in world units."""
    edge = np.array([[x, y] for x in (0, camera.width - 1) for y in (0, camera.height - 1)])
    origins, directions = camera.rays(edge)
    along = camera.cosines(directions)
    return np.concatenate([origins + directions * (depth / along)[:, None] for depth in (near, far)])
