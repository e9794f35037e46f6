"""Quantisation of voxel values to the atlas's 8 bits (section 5.4)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

DITHER_BELOW = 12  # levels of alpha, of 255: below it one level is more than a twelfth of the value, so values are dithered
# The same of square roots. Above it a level is less than a sixty-fourth of alpha, and rounding is off by less than dither is.
DITHER_ROOTS_BELOW = 128


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


def quantize_roots(values: NDArray[Any], noise: NDArray[Any]) -> NDArray[Any]:
    """Quantise values to the uint8 [N, C] whose squares, over 255^2, they are: for scenes of thin fog (Scene.square_roots).

    Arguments as of `quantize`. Levels lie as close as the square root of a value: the error that dither leaves of a ray through fog is then
    about a quarter of an 8-bit level of a picture, however thin the fog. With even levels it grows as the fog gets thinner.

    Each value becomes one of the two roots around it, so that the squares have its mean; where the stored alpha is at least
    DITHER_ROOTS_BELOW, the nearer one. Where the stored alpha is 0, all channels are 0.
    """
    squares = values * np.float32(255**2)
    thin = squares[:, -1:] < DITHER_ROOTS_BELOW**2
    noise = np.where(thin, noise, np.float32(0.5))
    alpha = _root(squares[:, -1:], noise[:, -1:])
    straight = np.minimum(squares[:, :-1] / np.maximum(squares[:, -1:], np.float32(1e-9)), 1)
    colour = _root(np.where(thin | (alpha == 0), straight * np.square(alpha), squares[:, :-1]), noise[:, :-1])
    stored: NDArray[np.uint8] = np.minimum(np.concatenate([colour, alpha], axis=-1), 255).astype(np.uint8)
    return stored


def _root(squares: NDArray[Any], noise: NDArray[Any]) -> NDArray[Any]:
    """The whole root below each number or the one above. With `noise`, uniform in [0, 1), the mean of their squares is the number."""
    below = np.floor(np.sqrt(squares))
    return np.asarray(below + (noise < (squares - np.square(below)) / (2 * below + 1)))
