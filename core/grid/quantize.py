"""Floats to the 8 bits of the atlas (section 5.4)."""

from __future__ import annotations

import numpy as np

THIN = 12  # levels of alpha below which rounding is dithered


def quantize(colour: np.ndarray, alpha: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Premultiplied values [N, C - 1] and alpha [N], all in [0, 1], to uint8 [N, C], alpha last; noise: [N, C] in [0, 1).

    Rounded to nearest, except thin fog: there a level is a large step and rounding would turn a fog of 0.7 into
    black or white, so it is dithered, alpha first and the rest at the colour that it then needs (hard case 51). No
    alpha, no colour: empty voxels are all 0.
    """
    level = alpha * np.float32(255)
    thin = level < THIN
    noise = np.where(thin[:, None], noise, np.float32(0.5))
    stored = np.minimum(np.floor(level + noise[:, -1]), 255)
    straight = colour / np.maximum(alpha, 1e-12)[:, None]
    wanted = np.where(thin[:, None], straight * stored[:, None], colour * np.float32(255))
    values = np.minimum(np.floor(wanted + noise[:, :-1]), 255)
    values[stored == 0] = 0
    return np.concatenate([values, stored[:, None]], axis=-1).astype(np.uint8)
