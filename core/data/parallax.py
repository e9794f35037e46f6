"""Finds points of a scene from the pictures themselves, where nothing else says how far away things are (plane sweep, Collins 1996).

Small patches are projected at many distances into other pictures; a patch lies where the pictures agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..io.images import over, read_image
from .dataset import View

VIEWS = 24  # pictures that are read, evenly spaced among all
WIDTH = 96  # pixels across to which pictures are reduced
GRID = 8  # patches along each side of a picture
PATCH = ((0, 0), (-2, 0), (2, 0), (0, -2), (0, 2))  # pixels of a patch, relative to its middle
REACH = (1.0, 100.0, 40)  # distances tried: from, to, relative to the cameras' spread, and their number
OTHERS = 2  # other pictures that must show a patch at a distance
AGREE = 0.5  # a patch is found if its least difference is below this part of its median one
CONTRAST = 0.02  # least median difference of a patch, of 1: a patch without texture agrees everywhere


def points_by_parallax(views: Sequence[View], spread: float) -> NDArray[Any]:
    """Points [N, 3] float64, world units, on the surfaces that the pictures show; few or none where they have no texture.

    spread: of the cameras' positions, world units. Reads the pictures. Raises SnergError when one cannot be read.
    """
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(len(views), VIEWS)).astype(int))]
    small = [_small(view) for view in chosen]
    distances = spread * np.geomspace(*REACH[:2], int(REACH[2]))
    found = [_patches(index, small, distances) for index in range(len(small))]
    return np.concatenate(found) if found else np.zeros((0, 3))


def _small(view: View) -> tuple[Camera, NDArray[Any]]:
    """(the camera, the picture float32 [H, W, 3] in [0, 1] over white), reduced to about WIDTH pixels across."""
    factor = max(1, round(view.camera.width / WIDTH))
    pixels = over(read_image(view.image, upright=view.upright))
    camera = view.camera.reduced(factor)
    pixels = pixels[: camera.height * factor, : camera.width * factor]
    return camera, pixels.reshape(camera.height, factor, camera.width, factor, 3).mean(axis=(1, 3))


def _patches(index: int, small: list[tuple[Camera, NDArray[Any]]], distances: NDArray[Any]) -> NDArray[Any]:
    """The middles [N, 3] of the patches of one picture whose distance other pictures agree on."""
    camera, picture = small[index]
    across, down = (np.linspace(3, side - 4, GRID).astype(int) for side in (camera.width, camera.height))
    middles = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 1, 2)
    pixels = middles + np.array(PATCH)  # [P, K, 2]
    wanted = picture[pixels[..., 1], pixels[..., 0]]
    origins, directions = (a.reshape(*pixels.shape[:2], 3) for a in camera.rays(pixels.reshape(-1, 2)))
    points = origins[:, None] + directions[:, None] * distances[:, None, None]  # [P, D, K, 3]
    total, count = np.zeros(points.shape[:2]), np.zeros(points.shape[:2])
    for other, (seer, image) in enumerate(small):
        if other != index:
            place, depth = seer.project(points.reshape(-1, 3))
            place = np.floor(place).clip(-1, 2**30).astype(int)
            inside = (depth > 0) & ((place >= 0) & (place < [seer.width, seer.height])).all(axis=-1)
            colour = image[np.where(inside, place[:, 1], 0), np.where(inside, place[:, 0], 0)].reshape(*points.shape[:3], 3)
            shown = inside.reshape(points.shape[:3]).all(axis=-1)
            total += np.where(shown, np.abs(colour - wanted[:, None]).mean(axis=(2, 3)), 0)
            count += shown
    difference = np.where(count >= OTHERS, total / np.maximum(count, 1), np.nan)
    known = np.flatnonzero(np.isfinite(difference).sum(axis=1) > len(distances) // 4)
    difference, points = difference[known], points[known]
    if not len(known):
        return np.zeros((0, 3))
    best, middle = np.nanargmin(difference, axis=1), np.nanmedian(difference, axis=1)
    least = np.nanmin(difference, axis=1)
    good = np.flatnonzero((middle > CONTRAST) & (least < AGREE * middle))
    return np.asarray(points[good, best[good], 0])
