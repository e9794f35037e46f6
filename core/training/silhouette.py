"""Images on a plain backdrop, without alpha: where the object ends is seen all the same."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..nerf.sampling import dilated

EDGE = 2  # pixels round anything else that do not count as backdrop: edges are mixed, and narrow gaps may be highlights


def border_share(image: NDArray[Any], colour: NDArray[Any]) -> float:
    """Share of an image's outermost pixels, uint8 [H, W, 3], that have just the colour, uint8 [3]."""
    edges = (image[0], image[-1], image[1:-1, 0], image[1:-1, -1])
    return float((np.concatenate(edges) == colour).all(axis=-1).mean())


def silhouette(image: NDArray[Any], colour: NDArray[Any]) -> NDArray[Any]:
    """bool [H, W]: what is not backdrop, which is all of just that colour that hangs together with the image's border.

    What has the backdrop's colour inside the object stays. image: uint8 [H, W, 3]; colour: uint8 [3].
    """
    plain = ~dilated(~(image == colour).all(axis=-1), EDGE)
    seed = plain.copy()
    seed[1:-1, 1:-1] = False
    return ~spread(seed, plain)


def spread(seed: NDArray[Any], allowed: NDArray[Any]) -> NDArray[Any]:
    """bool [H, W]: what can be reached from the seed, bool [H, W], along rows and columns of what is allowed, bool [H, W].

    A sweep fills whole runs of a row or column at once, so that a handful of sweeps is enough for most outlines.
    """
    reached, before = seed & allowed, -1
    while (now := int(reached.sum())) != before:
        before = now
        reached = _fill_runs(reached, allowed)
        reached = _fill_runs(reached.T, allowed.T).T
    return reached


def _fill_runs(reached: NDArray[Any], allowed: NDArray[Any]) -> NDArray[Any]:
    """Runs of a row that are allowed, whole where any of their pixels is reached."""
    begins = np.diff(allowed, axis=1, prepend=~allowed[:, :1]) != 0
    run = np.cumsum(begins.reshape(-1)) - 1
    hit = np.zeros(int(run[-1]) + 1, bool)
    hit[run[reached.reshape(-1)]] = True
    return hit[run].reshape(allowed.shape) & allowed
