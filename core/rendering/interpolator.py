"""Trilinear interpolation of the atlas for many samples at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .acceleration import STRIDES, Acceleration

CORNER_OFFSETS = np.array([x * STRIDES[0] + y * STRIDES[1] + z for x in (0, 1) for y in (0, 1) for z in (0, 1)])
MAX_INTERPOLATED = 32768  # samples a call: bounds the buffers; enough that threads rarely wait for Python's lock


class Interpolator:
    """Interpolates between the 8 voxels of a stencil. It reuses its buffers, so each thread needs its own."""

    def __init__(self, acceleration: Acceleration) -> None:
        self.acceleration, self.packed = acceleration, acceleration.voxels.ndim == 1
        channels = acceleration.channels
        self.corners = [acceleration.voxels[offset:] for offset in CORNER_OFFSETS]
        self.words = np.empty(8 * MAX_INTERPOLATED, acceleration.voxels.dtype)
        self.values = np.empty(8 * MAX_INTERPOLATED * channels, np.float32)
        self.difference = np.empty(4 * MAX_INTERPOLATED * channels, np.float32)
        self.fractions = np.empty(MAX_INTERPOLATED * channels // 2, np.uint64)

    def __call__(self, base: NDArray[Any], fraction: NDArray[Any]) -> NDArray[Any]:
        """Interpolated values [n, C] float32 of at most MAX_INTERPOLATED samples, from 0 to Acceleration.unit.

        base: [n] index of the stencil's lowest corner in Acceleration.voxels; fraction: [3, n] float32 in [0, 1), the position in it.
        The result is a view of a buffer that the next call overwrites.
        """
        count, channels = len(base), self.acceleration.channels
        values = self.values[: 8 * count * channels].reshape(8, -1)
        if self.packed:
            words = self.words[: 8 * count].reshape(8, -1)
            for corner, word in zip(self.corners, words, strict=True):
                corner.take(base, out=word, mode="clip")
            np.copyto(values, words.view(np.uint8))
        else:
            for corner, value in zip(self.corners, values.reshape(8, count, channels), strict=True):
                corner.take(base, axis=0, out=value, mode="clip")
        if self.acceleration.squared:
            np.square(values, out=values)
        for axis, half in enumerate((4, 2, 1)):
            self.blend(values[:half], values[half : 2 * half], self.repeat_channels(fraction[axis]))
        result: NDArray[Any] = values[0].reshape(count, channels)
        return result

    def blend(self, low: NDArray[Any], high: NDArray[Any], fraction: NDArray[Any]) -> None:
        """Linear interpolation in place: low += fraction * (high - low). All [k, n * C]; fraction [n * C]."""
        difference = self.difference[: low.size].reshape(low.shape)
        np.subtract(high, low, out=difference)
        difference *= fraction
        low += difference

    def repeat_channels(self, fraction: NDArray[Any]) -> NDArray[Any]:
        """[n] float32 to [n * C], each value C times in a row; two values are written at once as a 64-bit word, which is fastest."""
        pair = fraction.view(np.uint32).astype(np.uint64)
        pair |= pair << np.uint64(32)
        pairs = self.fractions[: len(fraction) * self.acceleration.channels // 2].reshape(len(fraction), -1)
        for i in range(pairs.shape[1]):
            pairs[:, i] = pair
        return pairs.view(np.float32).reshape(-1)
