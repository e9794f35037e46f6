"""The rays that the visibility pass marches: as many as the voxels need, whatever the number of the camera's own pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.box import Box
from ..geometry.camera import Camera
from ..geometry.ndc import Ndc
from ..rendering.render import TILE, tiled_pixels

# Voxels of the marched scene between two rays where the scene is farthest from the camera. A point of the picture is then at most 0.85
# voxels away from a ray that is marched, and at most 0.5 voxels along it from a sample: together less than the one voxel by which what
# the rays visit is dilated. Where a surface is seen at a low angle, the next ray above passes it within a voxel.
RAY_SPACING = 1.2
MAX_RAYS = 2**24  # of a camera: bounds the time for one that is far away and whose lens keeps its picture from being cut to the scene
RAYS_PER_BAND = 2**20  # marched at once: bounds the memory


@dataclass(frozen=True, eq=False)
class RayGrid:
    """A regular grid of points in a camera's picture, one ray each."""

    camera: Camera
    low: NDArray[np.float64]  # [2] pixel coordinates of the grid's corner; (0, 0) is the picture's
    step: NDArray[np.float64]  # [2] pixels between two rays
    columns: int
    rows: int

    @property
    def count(self) -> int:
        """How many rays it has."""
        return self.columns * self.rows

    def bands(self) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Origins and unit directions [N, 3] of all rays, in bands of rows; in each, tile by tile as the marcher wants them."""
        rows = max(RAYS_PER_BAND // max(self.columns, 1) // TILE, 1) * TILE
        for first in range(0, self.rows if self.columns else 0, rows):
            points = tiled_pixels(self.columns, min(rows, self.rows - first)) + np.array([0, first])
            yield self.camera.rays(self.low + (points + 0.5) * self.step - 0.5)


def ray_grid(camera: Camera, occupied: Box, voxel_size: float, ndc: Ndc | None) -> RayGrid:
    """The rays of a camera that come RAY_SPACING voxels or closer to one another everywhere in a box.

    occupied: outside of it there is nothing. voxel_size: of the scene to march, in units of the box's space (see Scene.ndc).
    """
    whole = np.array([camera.width, camera.height], np.float64)
    low, high = (np.zeros(2), whole) if ndc is not None else _seen_rectangle(camera, occupied, whole)
    step = RAY_SPACING * voxel_size * pixels_per_unit(camera, occupied, ndc)
    columns, rows = (int(n) for n in np.ceil(np.maximum(high - low, 0) / step))
    if columns * rows > MAX_RAYS:
        shrink = math.sqrt(MAX_RAYS / (columns * rows))
        columns, rows = max(int(columns * shrink), 1), max(int(rows * shrink), 1)
    return RayGrid(camera, low, (high - low) / np.maximum([columns, rows], 1), columns, rows)


def _seen_rectangle(camera: Camera, occupied: Box, whole: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two corners [2] of the part of the picture in which a box lies; of all of it where straight edges need not be straight in it, or the
    box reaches behind the camera. Both are equal where the box is not in the picture."""
    pixels, depth = camera.project(occupied.corners())
    if not camera.is_wide and depth.max() <= 0:
        return np.zeros(2), np.zeros(2)
    if camera.is_wide or camera.distortion is not None or depth.min() <= 0:
        return np.zeros(2), whole
    return np.clip(pixels.min(axis=0), 0, whole), np.clip(pixels.max(axis=0), 0, whole)


def pixels_per_unit(camera: Camera, occupied: Box, ndc: Ndc | None) -> NDArray[np.float64]:
    """Pixels [2] along a length of 1 across a ray at the far end of a box, in units of its space."""
    focal = np.array(camera.focal)
    if camera.projection == "orthographic":
        return focal
    if ndc is not None:  # independent of depth for a camera at the origin of the NDC, about the same for cameras near it
        return np.asarray(focal / np.array(ndc.focal))
    corners = occupied.corners()
    if camera.is_wide or camera.distortion is not None:
        farthest = float(np.linalg.norm(corners - camera.position, axis=-1).max())
    else:
        farthest = float(camera.project(corners)[1].max())
    return np.asarray(focal / max(farthest, 1e-12))
