"""Early termination of training rays: samples past the termination depth cost time and have no gradient. Method of our own.

A ray terminates where its transmittance (NeRF, eq. 3) falls below DARK.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ray_dataset import RayDataset

MOST_TILES = 2**20  # bound on the memory: 4 MB of depths
DARK = 1e-3  # transmittance below which a ray terminates
LEFT = 1e-2  # a ray that was cut while its transmittance was above this is left out of the loss
EASE = 0.25  # weight of a new, smaller depth in a tile's running mean


class TerminationDepths:
    """The termination depth of each small tile of pixels, as measured while training.

    Estimating it from an occupancy grid makes training collapse: some rays are cut in front of their surface, training raises the
    density before the cut to compensate, and the next estimate is even smaller. Here each step measures where its rays terminated. A tile
    keeps the largest depth, and smaller ones lower it only slowly. A ray that was cut before it terminated resets its tile
    to infinity, and is left out of that step's loss.
    """

    def __init__(self, ray_dataset: RayDataset) -> None:
        """Square tiles, as small as MOST_TILES allows; every depth is infinite at first."""
        self.starts, self.ends, self.widths = ray_dataset.starts, ray_dataset.ends, ray_dataset.widths
        heights = (ray_dataset.ends - ray_dataset.starts) // ray_dataset.widths
        self.side = max(1, int(np.ceil(np.sqrt(len(ray_dataset.pixels) / MOST_TILES))))
        self.across = -(-self.widths // self.side)
        tiles = self.across * -(-heights // self.side)
        self.first = np.cumsum(tiles) - tiles
        self.depths = np.full(int(tiles.sum()), np.inf, np.float32)

    def tile(self, index: NDArray[Any]) -> NDArray[Any]:
        """The tiles [N] that contain the pixels with numbers `index` [N]."""
        view = np.searchsorted(self.ends, index, side="right")
        row, column = np.divmod(index - self.starts[view], self.widths[view])
        return np.asarray(self.first[view] + row // self.side * self.across[view] + column // self.side)

    def learn(self, tile: NDArray[Any], end: NDArray[Any]) -> None:
        """Record that rays of tiles [N] terminated at distances [N], infinite where they did not. Of several rays of one tile the
        largest distance counts."""
        order = np.argsort(end, kind="stable")
        tile, end = tile[order], end[order]
        kept = self.depths[tile]
        known = np.isfinite(kept) & np.isfinite(end)
        closer = np.where(known, kept, 0) * np.float32(1 - EASE) + np.where(known, end, 0) * np.float32(EASE)
        self.depths[tile] = np.where(known & (end < kept), closer, end)
