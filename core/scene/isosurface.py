"""The surface at which a baked scene's alpha crosses a threshold, as a mesh: naive surface nets (Gibson 1998)."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from .blocks import CELL_VOXELS, DATA_VOXELS, block_coordinates
from .scene import Scene

CORNERS = np.array(list(product((0, 1), repeat=3)))  # of a cube between eight voxel centres
EDGES = np.array([(i, i + step) for step in (4, 2, 1) for i in range(8) if not i & step])  # pairs of corners
ROUND = tuple(np.insert(np.array([(0, 0), (-1, 0), (-1, -1), (0, -1)]), axis, 0, axis=1) for axis in range(3))  # cubes round an edge


def isosurface(scene: Scene, threshold: float = 0.5) -> tuple[NDArray[Any], NDArray[Any]]:
    """Vertices [N, 3] float64 along the box's axes, from the box's centre, in units of the grid's world; and quads [Q, 4] int64 of
    them, counter-clockwise seen from outside.

    Each cube between eight voxel centres in which alpha crosses the threshold has a vertex, the mean of the crossings on its edges;
    each pair of neighbouring voxels between which it crosses has a quad. Raises SnergError where the scene's grid lies in device
    coordinates, or alpha crosses the threshold nowhere.
    """
    if scene.ndc is not None:
        raise SnergError("The scene is forward-facing: its grid lies in device coordinates, which no mesh has.")
    alphas = scene.cells[..., -1]
    mixed = [m for m in range(len(alphas)) if scene.linear(alphas[m].max()) >= threshold * scene.unit > scene.linear(alphas[m].min())]
    if not mixed:
        raise SnergError(f"Nothing in the scene is as opaque as {threshold:g}; its surface has no mesh.")
    places = block_coordinates(scene.indirection)
    parts = [block_surface(scene.linear(alphas[m]) / np.float32(scene.unit), places[m] * DATA_VOXELS - 1, threshold) for m in mixed]
    cubes, points, quads = (np.concatenate(part) for part in zip(*parts, strict=True))
    dims = tuple(n + 2 * CELL_VOXELS for n in scene.shape)
    keys, first = np.unique(flat(cubes, dims), return_index=True)  # neighbouring blocks share the cubes between them
    quads = np.unique(np.searchsorted(keys, flat(quads, dims)), axis=0)
    return (points[first] + 0.5 - np.array(scene.shape) / 2) * scene.voxel_size, quads


def flat(places: NDArray[Any], dims: tuple[int, ...]) -> NDArray[Any]:
    """Integers [...] in place of voxels [..., 3], which may lie outside the grid by less than a cell."""
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(places + CELL_VOXELS, -1, 0)), dims))


def block_surface(alpha: NDArray[Any], corner: NDArray[Any], threshold: float) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The surface in a cell of the atlas: alpha [32, 32, 32], whose first voxel is the grid's voxel `corner` [3].

    Returns the cubes [N, 3] that have a vertex, by their first voxel; the vertices [N, 3] in voxels, 0 at the centre of the grid's
    first; and quads [Q, 4, 3] of cubes.
    """
    inside = alpha >= threshold
    eight = np.stack([inside[x : x + 31, y : y + 31, z : z + 31] for x, y, z in CORNERS])
    cubes = np.argwhere(eight.any(axis=0) & ~eight.all(axis=0))
    values = alpha[tuple(np.moveaxis(cubes[:, None] + CORNERS, -1, 0))]
    first, second = values[:, EDGES[:, 0]], values[:, EDGES[:, 1]]
    crosses = (first >= threshold) != (second >= threshold)
    along = np.where(crosses, (threshold - first) / np.where(crosses, second - first, 1), 0)[..., None]
    ends = CORNERS[EDGES]
    points = (crosses[..., None] * (ends[:, 0] + along * (ends[:, 1] - ends[:, 0]))).sum(axis=1) / crosses.sum(axis=1)[:, None]
    quads = np.concatenate([axis_quads(inside, axis) for axis in range(3)])
    return cubes + corner, cubes + points + corner, quads + corner


def axis_quads(inside: NDArray[Any], axis: int) -> NDArray[Any]:
    """[Q, 4, 3]: the four cubes round each pair of neighbours along an axis of which one is inside, of the lines without apron."""
    lines = tuple(slice(None) if other == axis else slice(1, -1) for other in range(3))
    own = inside[lines].astype(np.int8)
    change = np.diff(own, axis=axis)
    found = np.argwhere(change)
    leaves = change[tuple(found.T)] < 0  # the first of the pair is inside, so the surface faces along the axis
    offset = np.ones(3, np.int64)
    offset[axis] = 0
    quads = (found + offset)[:, None] + ROUND[axis]
    forward = leaves if axis != 1 else ~leaves  # y is between z and x: the square is traversed the other way
    return np.where(forward[:, None, None], quads, quads[:, ::-1])
