"""Errors between two images: mean squared error, PSNR, SSIM and FLIP."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from .packages import needs_package

WINDOW = 11  # taps of SSIM's Gaussian, and its standard deviation in pixels (Wang et al. 2004)
SIGMA = 1.5
IDENTICAL = 100.0  # dB of an identical view in a mean over views; a difference of half a level of 8 bits has 54 dB
K1, K2 = 0.01, 0.03  # of SSIM, stabilise its fractions (Wang et al. 2004, section III.B)


def mse(a: NDArray[Any], b: NDArray[Any], mask: NDArray[Any] | None = None) -> float:
    """Mean squared error of two images [H, W, C] in [0, 1], computed in float64. mask: [H, W] bool, the pixels that count.

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
    """Peak signal-to-noise ratio in dB of images [H, W, C] in [0, 1]; infinite where they are identical (hard case 30). Raises as `mse`."""
    return psnr_of(mse(a, b))


def psnr_of(error: float) -> float:
    """PSNR in dB of a mean squared error of values in [0, 1]; infinite for 0."""
    return -10 * math.log10(error) if error > 0 else math.inf


def mean_psnr(errors: Iterable[float]) -> float:
    """The mean of the PSNRs of several views in dB, from their mean squared errors, as published tables have it (hard case 30).

    An identical view counts as IDENTICAL dB beside others that are not; infinite where all are identical. Raises SnergError when there
    are none.
    """
    values = _some(errors)
    if not any(values):
        return math.inf
    return sum(min(psnr_of(error), IDENTICAL) for error in values) / len(values)


def pooled_psnr(errors: Iterable[float]) -> float:
    """PSNR in dB of the mean of the mean squared errors of several views: lower than `mean_psnr` where views differ, infinite where all
    are identical. Raises SnergError when there are none.
    """
    values = _some(errors)
    return psnr_of(sum(values) / len(values))


def _some(errors: Iterable[float]) -> list[float]:
    values = list(errors)
    if not values:
        raise SnergError("There are no views to measure.")
    return values


def ssim(a: NDArray[Any], b: NDArray[Any], mask: NDArray[Any] | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of images [H, W, C] in [0, 1], mean over pixels and channels.

    The window is an 11 x 11 Gaussian with a standard deviation of 1.5 pixels, at the pixels where it is inside the image. mask: [H, W]
    bool, the pixels that count; the others are taken to be equal in both images. Raises SnergError as `mse` does, for images with a side
    under 11 pixels, and where SciPy is not installed.
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


def flip(picture: NDArray[Any], truth: NDArray[Any], mask: NDArray[Any] | None = None) -> float | None:
    """Mean FLIP error (Andersson et al. 2020) of an image [H, W, 3] in [0, 1]: 0 where it looks alike, at most 1.

    As a viewer sees both in turn at 67 pixels a degree. mask: [H, W] bool, the pixels that count; the others are taken to be equal in both
    images. None where the package flip-evaluator is not installed. Raises SnergError as `mse` does.
    """
    mse(picture, truth, mask)
    try:
        import flip_evaluator
    except ImportError:
        return None
    if mask is not None:
        picture = np.where(mask[..., None], picture, truth)
    images = (np.ascontiguousarray(image, np.float32) for image in (truth, picture))
    errors = np.asarray(flip_evaluator.evaluate(*images, "LDR", applyMagma=False)[0])[..., 0]
    return float(errors.mean() if mask is None else errors[mask].mean())


def blur(x: NDArray[Any]) -> NDArray[Any]:
    """x [H, W, C] convolved with SSIM's Gaussian where the window is inside the image: [H - 10, W - 10, C]."""
    with needs_package("scipy", "Measurements of SSIM"):
        from scipy import ndimage
    half = WINDOW // 2
    taps = np.exp(-0.5 * ((np.arange(WINDOW) - half) / SIGMA) ** 2)
    taps /= taps.sum()
    for axis in (0, 1):
        x = ndimage.correlate1d(x, taps, axis=axis)
    return x[half:-half, half:-half]
