"""Quantisation of voxel values to the atlas's 8 bits (section 5.4)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

DITHER_BELOW = 12  # levels of alpha, of 255: below it one level is more than a twelfth of the value, so values are dithered


def quantize(values: NDArray[Any], noise: NDArray[Any]) -> NDArray[Any]:
    """Quantise values to uint8 [N, C].

    values: [N, C] float32 in [0, 1], alpha last, the others premultiplied by it. noise: [N, C] uniform in [0, 1), the dither.

    Values are rounded to nearest. Where alpha is below DITHER_BELOW they are dithered instead: rounding would turn the colour of thin fog
    black or white. Alpha is dithered first, then the others are set so that the straight colour stays. Where the stored alpha is 0, all
    channels are 0 (hard case 51).
    """
    level = values * np.float32(255)
    stored = level + np.float32(0.5)
    thin = np.flatnonzero(level[:, -1] < DITHER_BELOW)
    alpha = np.floor(level[thin, -1] + noise[thin, -1])
    straight = level[thin, :-1] / np.maximum(level[thin, -1:], np.float32(1e-9))
    stored[thin, -1] = alpha
    stored[thin, :-1] = np.where(alpha[:, None] > 0, straight * alpha[:, None] + noise[thin, :-1], 0)
    return np.minimum(stored, 255).astype(np.uint8)
