"""How near one picture is to another. NumPy alone."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError

WINDOW = 11  # taps of SSIM's Gaussian
SIGMA = 1.5
K1, K2 = 0.01, 0.03


def mse(a: NDArray[Any], b: NDArray[Any], mask: NDArray[Any] | None = None) -> float:
    """Mean squared error of two pictures [H, W, C] in [0, 1], computed in float64. mask: [H, W] bool, the pixels that count.

    Raises SnergError when their shapes differ, a value is not finite, or no pixel counts.
    """
    if a.shape != b.shape:
        raise SnergError(f"Pictures of {a.shape} and {b.shape} cannot be compared; render at the size of the dataset's images.")
    squares = (a.astype(np.float64) - b.astype(np.float64)) ** 2
    if mask is not None and not mask.any():
        raise SnergError("A picture's mask hides all of it, so that nothing can be compared; take the view out of the dataset.")
    error = float((squares if mask is None else squares[mask]).mean())
    if not math.isfinite(error):
        raise SnergError("A picture to compare holds values that are not finite.")
    return error


def psnr(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Peak signal-to-noise ratio in dB of pictures in [0, 1]; infinite for identical ones (hard case 30)."""
    return psnr_of(mse(a, b))


def psnr_of(error: float) -> float:
    """dB of a mean squared error."""
    return -10 * math.log10(error) if error > 0 else math.inf


def mean_psnr(errors: Iterable[float]) -> float:
    """dB of the mean of the errors of several views, so that one perfect view does not make it infinite (hard case 30).

    Raises SnergError when there are none.
    """
    values = list(errors)
    if not values:
        raise SnergError("There are no views to measure.")
    return psnr_of(sum(values) / len(values))


def ssim(a: NDArray[Any], b: NDArray[Any], mask: NDArray[Any] | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of pictures [H, W, C] in [0, 1], mean over pixels and channels.

    An 11 x 11 Gaussian of sigma 1.5, only where it fits whole. mask: [H, W] bool, the pixels that count; around them, within
    a window, what does not count is taken for equal. Raises SnergError as `mse` does, or when they are under 11 pixels.
    """
    mse(a, b, mask)
    if min(a.shape[:2]) < WINDOW:
        raise SnergError(f"SSIM needs pictures of {WINDOW} x {WINDOW} pixels or more, not {a.shape[1]} x {a.shape[0]}.")
    a, b = a.astype(np.float64), b.astype(np.float64)
    half = WINDOW // 2
    counted = None
    if mask is not None:
        a, counted = np.where(mask[..., None], a, b), mask[half:-half, half:-half]
    mean_a, mean_b = blur(a), blur(b)
    variance_a, variance_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    c1, c2 = K1**2, K2**2
    likeness = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    likeness /= (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    return float(likeness[counted].mean() if counted is not None and counted.any() else likeness.mean())


def blur(x: NDArray[Any]) -> NDArray[Any]:
    """[H, W, C] convolved with the Gaussian where it fits: [H - 10, W - 10, C]."""
    taps = np.exp(-0.5 * ((np.arange(WINDOW) - WINDOW // 2) / SIGMA) ** 2)
    taps /= taps.sum()
    for axis in (0, 1):
        windows = np.lib.stride_tricks.sliding_window_view(x, WINDOW, axis=axis)
        x = windows @ taps
    return x
