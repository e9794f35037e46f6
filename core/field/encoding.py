"""Position encodings: the hash grid of the fast family (Müller et al. 2022, interpolated on tetrahedra)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

PRIMES = (2654435761, 805459861)


@dataclass(frozen=True)
class HashGrid:
    """levels of cells from `coarsest` to `finest` along the domain, `features` numbers a vertex, at most 2^log2_size vertices a level."""

    levels: int = 8
    coarsest: int = 16
    finest: int = 512
    features: int = 4
    log2_size: int = 17

    @cached_property
    def resolutions(self) -> np.ndarray:
        """[levels] cells along an axis, growing geometrically."""
        growth = np.linspace(0, 1, self.levels) if self.levels > 1 else np.zeros(1)
        return np.floor(self.coarsest * (self.finest / self.coarsest) ** growth + 1e-6).astype(np.int64)

    @cached_property
    def sizes(self) -> np.ndarray:
        """[levels] vertices stored: all of them where they fit, else the hash table's size."""
        return np.minimum((self.resolutions + 2) ** 3, 2**self.log2_size)

    @cached_property
    def rows(self) -> int:
        """Vertices of all levels together: the table is [rows, features]."""
        return int(self.sizes.sum())


def hash_lookup(xnp: Any, grid: HashGrid, x: Any) -> tuple[Any, Any]:
    """Which vertices of the table a point needs, and with what weights.

    x: [N, 3] in [0, 1]. Returns indices int32 [N, levels, 4] and weights float32 [N, levels, 4]. A cell is cut
    into six tetrahedra along its diagonal, so 4 vertices do where a cube needs 8, and the result is continuous.
    It depends on the points alone: compile it apart from what uses it, or XLA repeats it for every feature.
    """
    scaled = x[:, None, :] * grid.resolutions.astype(np.float32)[None, :, None]
    cell = xnp.floor(scaled)
    fx, fy, fz = (scaled[..., axis] - cell[..., axis] for axis in range(3))
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
    vertices = [vertex_index(xnp, grid, [base[..., a] + (order[a] < step) for a in range(3)]) for step in range(4)]
    return xnp.stack(vertices, axis=-1), weights


def vertex_index(xnp: Any, grid: HashGrid, corner: list[Any]) -> Any:
    """Rows int32 [N, levels] of the table for vertices given by x, y, z, each [N, levels]: by place where a level fits, else hashed."""
    side = (grid.resolutions + 2).astype(np.uint32)
    x, y, z = (c.astype(xnp.uint32) for c in corner)
    hashed = (x ^ (y * np.uint32(PRIMES[0])) ^ (z * np.uint32(PRIMES[1]))) & np.uint32(2**grid.log2_size - 1)
    fits = (grid.resolutions + 2) ** 3 <= 2**grid.log2_size
    offset = (np.cumsum(grid.sizes) - grid.sizes).astype(np.uint32)
    return (xnp.where(fits, (x * side + y) * side + z, hashed) + offset).astype(xnp.int32)


def hash_encode(grid: HashGrid, table: Any, indices: Any, weights: Any) -> Any:
    """The table, flat [rows * features], at `hash_lookup`'s vertices: [N, levels * features].

    Flat, because Adam takes a third of the time over one long axis that it takes over many rows of a few features.
    """
    rows = table.reshape(-1, grid.features)
    found = rows[indices] if isinstance(table, np.ndarray) else rows.at[indices].get(mode="promise_in_bounds")
    return (found * weights[..., None]).sum(axis=2).reshape(len(indices), -1)
