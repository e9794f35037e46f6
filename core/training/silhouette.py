"""Silhouettes of objects before a plain backdrop, for opaque images: the backdrop is found by flood fill from the image's border.

The silhouettes carve the visual hull (Laurentini 1994). Flood fill is the standard algorithm, 4-connected.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..nerf.sampling import dilated

EDGE = 2  # pixels by which the object is dilated before the fill: its antialiased edge is no backdrop, nor is a gap of up to 4 pixels


def border_share(image: NDArray[Any], colour: NDArray[Any]) -> float:
    """Share in [0, 1] of the border pixels of an image, uint8 [H, W, 3], that have exactly the colour, uint8 [3]."""
    edges = (image[0], image[-1], image[1:-1, 0], image[1:-1, -1])
    return float((np.concatenate(edges) == colour).all(axis=-1).mean())


def silhouette(image: NDArray[Any], colour: NDArray[Any]) -> NDArray[Any]:
    """The silhouette of an image, bool [H, W]: all but the backdrop, which is the pixels of its colour connected to the image's border.

    Pixels of the backdrop's colour inside the object belong to the object. image: uint8 [H, W, 3]; colour: uint8 [3].
    """
    plain = ~dilated(~(image == colour).all(axis=-1), EDGE)
    seed = plain.copy()
    seed[1:-1, 1:-1] = False
    return ~spread(seed, plain)


def spread(seed: NDArray[Any], allowed: NDArray[Any]) -> NDArray[Any]:
    """Flood fill, 4-connected: the pixels, bool [H, W], connected to `seed` by pixels of `allowed`, both bool [H, W].

    A pass fills whole runs of allowed pixels in rows and then in columns, so that few passes are needed for most outlines.
    """
    reached, before = seed & allowed, -1
    while (now := int(reached.sum())) != before:
        before = now
        reached = _fill_runs(reached, allowed)
        reached = _fill_runs(reached.T, allowed.T).T
    return np.asarray(reached)


def _fill_runs(reached: NDArray[Any], allowed: NDArray[Any]) -> NDArray[Any]:
    """The runs of allowed pixels in rows, bool [H, W], of which at least one pixel is reached."""
    begins = np.diff(allowed, axis=1, prepend=~allowed[:, :1]) != 0
    run = np.cumsum(begins.reshape(-1)) - 1
    hit = np.zeros(int(run[-1]) + 1, bool)
    hit[run[reached.reshape(-1)]] = True
    return np.asarray(hit[run].reshape(allowed.shape) & allowed)
