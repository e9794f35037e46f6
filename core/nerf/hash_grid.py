"""Position encodings: the hash grid of the fast family (Müller et al. 2022, interpolated on tetrahedra)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

PRIMES = (2654435761, 805459861)


@dataclass(frozen=True)
class HashGrid:
    """The sizes of a multiresolution hash grid: `levels` grids from `coarsest` to `finest` cells along the domain, with `features` numbers
    at each vertex and at most 2^log2_size stored vertices a level (Mueller et al. 2022, table 1)."""

    levels: int = 8
    coarsest: int = 16
    finest: int = 512
    features: int = 4
    log2_size: int = 17

    @cached_property
    def resolutions(self) -> NDArray[Any]:
        """Cells along an axis at each level, [levels], a geometric series."""
        growth = np.linspace(0, 1, self.levels) if self.levels > 1 else np.zeros(1)
        return np.asarray(np.floor(self.coarsest * (self.finest / self.coarsest) ** growth + 1e-6).astype(np.int64))

    @cached_property
    def sizes(self) -> NDArray[Any]:
        """Vertices stored at each level, [levels]: all of them where they fit in the hash table, else the table's size."""
        return np.minimum((self.resolutions + 2) ** 3, 2**self.log2_size)

    @cached_property
    def rows(self) -> int:
        """Vertices of all levels together."""
        return int(self.sizes.sum())


def hash_lookup(xnp: Any, grid: HashGrid, x: Any) -> tuple[Any, Any]:
    """The vertices of each level between which a point is interpolated, and their weights.

    x: [N, 3] in [0, 1]. Returns indices int32 [levels, N, 4] into a level's vertices and weights float32 [levels, N, 4]. A cell
    is cut into six tetrahedra along its diagonal, so 4 vertices do where a cube needs 8, and the result is continuous.
    It depends on the points alone: compile it apart from what uses it, or XLA repeats it for every feature.
    """
    scaled = x.T[:, None, :] * grid.resolutions.astype(np.float32)[:, None]
    cell = xnp.floor(scaled)
    fx, fy, fz = (scaled[axis] - cell[axis] for axis in range(3))
    base = cell.astype(xnp.uint32)
    highest = xnp.maximum(xnp.maximum(fx, fy), fz)
    lowest = xnp.minimum(xnp.minimum(fx, fy), fz)
    middle = fx + fy + fz - highest - lowest
    weights = xnp.stack([1 - highest, highest - middle, middle - lowest, lowest], axis=-1)
    # The path of four vertices steps along the axis of the largest fraction first; ties go to the earlier axis.
    order = (
        (fy > fx).astype(xnp.uint32) + (fz > fx).astype(xnp.uint32),
        (fx >= fy).astype(xnp.uint32) + (fz > fy).astype(xnp.uint32),
        (fx >= fz).astype(xnp.uint32) + (fy >= fz).astype(xnp.uint32),
    )
    vertices = [vertex_index(xnp, grid, [base[a] + (order[a] < step) for a in range(3)]) for step in range(4)]
    return xnp.stack(vertices, axis=-1), weights


def vertex_index(xnp: Any, grid: HashGrid, corner: list[Any]) -> Any:
    """Indices int32 [levels, N] of vertices in their level's table, from x, y, z, each uint32 [levels, N].

    A level whose vertices all fit in the table (the coarser ones) is indexed by position, others by the hash of the position.
    """
    fits = int(np.count_nonzero((grid.resolutions + 2) ** 3 <= 2**grid.log2_size))
    side = (grid.resolutions[:fits, None] + 2).astype(np.uint32)
    x, y, z = corner
    placed = (x[:fits] * side + y[:fits]) * side + z[:fits]
    hashed = (x[fits:] ^ (y[fits:] * np.uint32(PRIMES[0])) ^ (z[fits:] * np.uint32(PRIMES[1]))) & np.uint32(2**grid.log2_size - 1)
    return xnp.concatenate([placed, hashed]).astype(xnp.int32)


def hash_encode(xnp: Any, grid: HashGrid, tables: Sequence[Any], indices: Any, weights: Any) -> Any:
    """Interpolate the tables at `hash_lookup`'s vertices: [N, levels * features]. tables: one a level, flat [size * features].

    Flat, because Adam takes a third of the time over one long axis that it takes over many rows of a few features; and a table
    a level, because XLA then works on several at once.
    """
    levels = []
    for table, index, weight in zip(tables, indices, weights, strict=True):
        rows = table.reshape(-1, grid.features)
        found = rows[index] if xnp is np else rows.at[index].get(mode="promise_in_bounds")
        levels.append((found * weight[..., None]).sum(axis=1))
    return xnp.concatenate(levels, axis=-1)
