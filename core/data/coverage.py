"""Measures a box against a capture: which rays cross it, how much of it the cameras see, and which points lie inside.

All of these are shares in [0, 1]. They need poses and lenses alone, no pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.box import Box
from ..geometry.camera import Camera

RAYS = 16  # rays a side of each image that are tested: 256 an image
CELLS = 16  # cells a side of the box whose centres are tested
CAMERAS = 200  # cameras that are tested at most, evenly spaced among all


@dataclass(frozen=True)
class Coverage:
    """How a box fits a capture."""

    rays: float  # share of the images' rays that cross the box
    seen: float  # share of the box's volume that at least one camera sees, without regard to occlusion
    points: float | None  # share of the points inside; None without points

    def text(self) -> str:
        """A sentence with the shares in percent."""
        inside = "" if self.points is None else f", and {100 * self.points:.0f} % of the points lie inside"
        return f"{100 * self.rays:.0f} % of the rays cross it, cameras see {100 * self.seen:.0f} % of it{inside}."


def coverage(box: Box, cameras: Sequence[Camera], points: NDArray[Any] | None) -> Coverage:
    """The measures of a box. points: [N, 3] world units, or None."""
    inside = None if points is None or not len(points) else float(box.contains(points).mean())
    return Coverage(crossing(box, cameras), seen(box, cameras), inside)


def some(cameras: Sequence[Camera]) -> list[Camera]:
    """At most CAMERAS of the cameras, evenly spaced."""
    return [cameras[i] for i in np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), CAMERAS)).astype(int))]


def crossing(box: Box, cameras: Sequence[Camera]) -> float:
    """The share of the images' rays that cross the box in front of the camera (slab test, in the box's own axes)."""
    hits = total = 0
    for camera in some(cameras):
        across = ((np.arange(RAYS) + 0.5) * camera.width / RAYS).astype(int)
        down = ((np.arange(RAYS) + 0.5) * camera.height / RAYS).astype(int)
        origins, directions = camera.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
        origins = (origins - box.box_to_world[:3, 3]) @ box.box_to_world[:3, :3]
        directions = directions @ box.box_to_world[:3, :3]
        directions = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        first, second = (-box.size / 2 - origins) / directions, (box.size / 2 - origins) / directions
        enter, leave = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
        hits += int((leave > np.maximum(enter, 0)).sum())
        total += len(origins)
    return hits / total


def seen(box: Box, cameras: Sequence[Camera]) -> float:
    """The share of the box's volume that lies in at least one camera's frustum."""
    axis = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    local = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) * box.size
    unseen = local @ box.box_to_world[:3, :3].T + box.box_to_world[:3, 3]
    for camera in some(cameras):
        unseen = unseen[~camera.shows(unseen)]
        if not len(unseen):
            break
    return 1 - len(unseen) / CELLS**3


def median_depth(cameras: Sequence[Camera], points: NDArray[Any]) -> float | None:
    """The median over the cameras of the median distance of the points [N, 3] in view, world units; None when no camera sees a point."""
    points = points[:: max(1, len(points) // 20000)]
    depths = []
    for camera in some(cameras):
        visible = points[camera.shows(points)]
        if len(visible):
            depths.append(float(np.median(np.linalg.norm(visible - camera.position, axis=-1))))
    return float(np.median(depths)) if depths else None


def facing(cameras: Sequence[Camera], centre: NDArray[Any]) -> float:
    """The mean cosine between the cameras' view directions and the direction to `centre` [3]: 1 where all look at it, -1 where all
    look away from it."""
    axes = np.stack([-c.camera_to_world[:3, 2] for c in cameras])
    offsets = centre - np.stack([c.position for c in cameras])
    return float(((axes * offsets).sum(axis=-1) / np.maximum(np.linalg.norm(offsets, axis=-1), 1e-12)).mean())
