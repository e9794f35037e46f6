"""Floats to the 8 bits of the atlas (section 5.4)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

DITHER_BELOW = 12  # levels of alpha below which rounding is dithered


def quantize(values: NDArray[Any], noise: NDArray[Any]) -> NDArray[Any]:
    """Values premultiplied by alpha, alpha last, [N, C] in [0, 1] to uint8; noise: [N, C] in [0, 1).

    Rounded to nearest, except thin fog: there a level is a large step and rounding would turn a fog of 0.7 into
    black or white, so it is dithered, alpha first and the rest at the colour that it then needs (hard case 51). No
    alpha, no colour: empty voxels are all 0.
    """
    level = values * np.float32(255)
    stored = level + np.float32(0.5)
    thin = np.flatnonzero(level[:, -1] < DITHER_BELOW)
    alpha = np.floor(level[thin, -1] + noise[thin, -1])
    straight = level[thin, :-1] / np.maximum(level[thin, -1:], np.float32(1e-9))
    stored[thin, -1] = alpha
    stored[thin, :-1] = np.where(alpha[:, None] > 0, straight * alpha[:, None] + noise[thin, :-1], 0)
    return np.minimum(stored, 255).astype(np.uint8)
