"""What the depth in a dataset tells before the first step: which cells are empty, and where rays end.

Cells that a view looks through are empty (space carving; Kutulakos and Seitz 2000).
"""

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

EDGE = 1  # pixels around a pixel whose depths count as its own: a pixel at an edge shows surfaces before and behind it


def missing_share(dataset: Dataset, rays: RayDataset) -> float:
    """Reads all depths, and gives each ray the depth behind which it needs no samples, or infinity (`RayDataset.depth`).

    Returns the share in [0, 1] of the pixels with alpha that have no depth. Raises SnergError where a view has no depth, or a file cannot
    be read.
    """
    limits, missing, shown = np.full(len(rays.pixels), np.inf, np.float32), 0, 0
    for i, (start, end) in enumerate(zip(rays.starts, rays.ends, strict=True)):
        depth = dataset.depth(i)
        if depth is None:
            raise SnergError(f"The view {dataset.cameras[i].name} has no depth; render the dataset with depth, or set depth to off.")
        there, none = rays.pixels[start:end, 3].reshape(depth.shape) > 0, np.isnan(depth)
        missing, shown = missing + int((none & there).sum()), shown + int(there.sum())
        limits[start:end] = extreme(np.where(none, np.float32(np.inf), depth), EDGE, largest=True).reshape(-1)
    rays.depth = limits
    return missing / max(shown, 1)


def carve(dataset: Dataset, rays: RayDataset, domain: Domain, alive: NDArray[Any]) -> NDArray[Any]:
    """The cells of `alive`, bool [CELLS^3], that no view looks through. Raises SnergError where a depth cannot be read."""

    def limits() -> Iterator[NDArray[Any]]:
        for i, (start, end) in enumerate(zip(rays.starts, rays.ends, strict=True)):
            depth = dataset.depth(i)
            assert depth is not None
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
        inside = (depth > camera.near) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        nearest = extreme(limit, footprint(camera, depth[inside], radius), largest=False)
        through = inside.copy()
        through[inside] = depth[inside] + radius < nearest[row[inside], column[inside]]
        cells, points = cells[~through], points[~through]
    result = np.zeros_like(alive)
    result[cells] = True
    return result


def extreme(depth: NDArray[Any], radius: int, largest: bool) -> NDArray[Any]:
    """The largest or the smallest of the depths [H, W] in a square of 2 * radius + 1 pixels around each pixel."""
    choose = np.maximum if largest else np.minimum
    for axis in (0, 1):
        padded = np.pad(depth, [(radius, radius) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        size = depth.shape[axis]
        depth = choose.reduce([np.take(padded, range(k, k + size), axis=axis) for k in range(2 * radius + 1)])
    return np.asarray(depth)
