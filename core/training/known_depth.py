"""The cells that the depth in a dataset shows to be empty, before the first step (space carving; Kutulakos and Seitz 2000)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..errors import SnergError
from ..geometry.camera import Camera
from ..nerf.sampling import CELLS, Domain, cell_centres, footprint
from .ray_dataset import RayDataset


def carve(dataset: Dataset, rays: RayDataset, domain: Domain, alive: NDArray[Any]) -> NDArray[Any]:
    """The cells of `alive`, bool [CELLS^3], that no view looks through. Raises SnergError where a view has no depth, or a file
    cannot be read."""

    def limits() -> Iterator[NDArray[Any]]:
        for i, (start, end) in enumerate(zip(rays.starts, rays.ends, strict=True)):
            depth = dataset.depth(i)
            if depth is None:
                raise SnergError(f"The view {dataset.cameras[i].name} has no depth; render the dataset with depth, or set depth to off.")
            yield open_until(depth, rays.pixels[start:end, 3].reshape(depth.shape) if rays.alpha else None)

    return without_open(domain, alive, dataset.cameras, limits())


def open_until(depth: NDArray[Any], alpha: NDArray[Any] | None) -> NDArray[Any]:
    """The depth [H, W] up to which a view shows that there is nothing: infinite where alpha [H, W] is 0, 0 where nothing is known.

    depth: [H, W], NaN where there is no surface; alpha: of any unit, None where the image has none.
    """
    missing = np.isnan(depth)
    nothing = missing & (alpha == 0) if alpha is not None else np.zeros_like(missing)
    return np.where(missing, np.where(nothing, np.float32(np.inf), np.float32(0)), depth)


def without_open(domain: Domain, alive: NDArray[Any], cameras: Sequence[Camera], limits: Iterator[NDArray[Any]]) -> NDArray[Any]:
    """The cells of `alive`, bool [CELLS^3], that no view looks through. limits: each view's `open_until`.

    A cell behind the surfaces of all views stays, so that what is seen through glass does too.
    """
    cells = np.flatnonzero(alive)
    points = domain.to_world(cell_centres(CELLS)[cells])
    radius = np.sqrt(3) / CELLS / domain.scale
    for camera, limit in zip(cameras, limits, strict=True):
        pixels, depth = camera.project(points)
        column, row = np.floor(pixels).T.clip(-1, 2**30).astype(np.int64)
        inside = (depth > camera.near) & (depth < camera.far) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        nearest = smallest(limit, footprint(camera, depth[inside], radius))
        through = inside.copy()
        through[inside] = depth[inside] + radius < nearest[row[inside], column[inside]]
        cells, points = cells[~through], points[~through]
    result = np.zeros_like(alive)
    result[cells] = True
    return result


def smallest(depth: NDArray[Any], radius: int) -> NDArray[Any]:
    """The smallest of the depths [H, W] in a square of 2 * radius + 1 pixels around each pixel."""
    for axis in (0, 1):
        padded = np.pad(depth, [(radius, radius) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        size = depth.shape[axis]
        depth = np.minimum.reduce([np.take(padded, range(k, k + size), axis=axis) for k in range(2 * radius + 1)])
    return np.asarray(depth)
