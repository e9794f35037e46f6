"""Where training rays end: past what uses up their light, samples cost as much as before it and teach nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ray_dataset import RayDataset

MOST_TILES = 2**20
DARK = 1e-3  # a ray ends where less light than this is left
LEFT = 1e-2  # a ray that was cut with more light than this left is not learned from
EASE = 0.25  # how fast a tile's end comes closer


class RayEnds:
    """How far the rays of each small tile of pixels reach before their light is used up, as measured while training.

    Guessing it from an occupancy grid makes training collapse: such guesses end a few rays in front of surfaces, what
    shines through is made up for by more density there, and that feeds on itself. Here a step says where its rays really
    ended. The tile keeps the farthest of them, coming closer only slowly; a ray that turns out to be cut with light left
    sends its tile back to looking all the way, and is left out of that step's loss.
    """

    def __init__(self, pool: RayDataset) -> None:
        """Tiles as small as MOST_TILES of them allow, each looking all the way."""
        self.starts, self.ends, self.widths = pool.starts, pool.ends, pool.widths
        heights = (pool.ends - pool.starts) // pool.widths
        self.side = max(1, int(np.ceil(np.sqrt(len(pool.pixels) / MOST_TILES))))
        self.across = -(-self.widths // self.side)
        tiles = self.across * -(-heights // self.side)
        self.first = np.cumsum(tiles) - tiles
        self.reach = np.full(int(tiles.sum()), np.inf, np.float32)

    def tile(self, index: NDArray[Any]) -> NDArray[Any]:
        """[N] the tiles of pixels by number."""
        view = np.searchsorted(self.ends, index, side="right")
        row, column = np.divmod(index - self.starts[view], self.widths[view])
        return self.first[view] + row // self.side * self.across[view] + column // self.side

    def learn(self, tile: NDArray[Any], end: NDArray[Any]) -> None:
        """Rays of tiles [N] were seen to end at distances [N], infinite where light was left. Of several in one tile the
        farthest counts."""
        order = np.argsort(end, kind="stable")
        tile, end = tile[order], end[order]
        kept = self.reach[tile]
        known = np.isfinite(kept) & np.isfinite(end)
        closer = np.where(known, kept, 0) * np.float32(1 - EASE) + np.where(known, end, 0) * np.float32(EASE)
        self.reach[tile] = np.where(known & (end < kept), closer, end)
