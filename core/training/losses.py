"""Losses of training (eqs. 3 and 8, and one of ours), and what stands behind the images."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray


def cauchy(xnp: Any, density: Any, c: float = 0.5) -> Any:
    """log(1 + density^2 / c), elementwise (eq. 8, c = 1/2).

    Where the square would overflow, its limit 2 log(density) - log(c) (hard case 23).
    """
    large = density > 1e6
    small = xnp.where(large, 1.0, density)  # the branch not taken must have a finite gradient too
    big = xnp.where(large, density, 1.0)
    return xnp.where(large, 2 * xnp.log(big) - math.log(c), xnp.log1p(small * small / c))


def softness(weights: Any) -> Any:
    """w (1 - w), elementwise, of the weights with which samples are composited: over a ray, 0 where one sample takes all its light, or
    none any, and near the ray's opacity where many share it.

    Ours, in the manner of priors for hard surfaces. Its slope is at most 1 where that of the squared error grows with the error, so that
    fog, which images call for, stays: what it decides is what they leave open, how far light goes into what ends it.
    """
    return weights * (1 - weights)


def plain_colour(name: str) -> NDArray[Any] | None:
    """The colour, uint8 [3], of a background called 'white', 'black' or '#rrggbb'; None for 'random', which is a new one each ray."""
    value = {"white": "#ffffff", "black": "#000000"}.get(name, name)
    return np.array(list(bytes.fromhex(value[1:])), np.uint8) if re.fullmatch("#[0-9a-fA-F]{6}", value) else None


def shown_over(name: str) -> NDArray[Any]:
    """The background colour, float32 [3] in [0, 1], over which a field is evaluated.

    name: the training's setting `background`. It is the colour of that name; white for 'random'.
    """
    colour = plain_colour(name)
    return np.ones(3, np.float32) if colour is None else colour.astype(np.float32) / 255


def backgrounds(name: str, rays: int, rng: np.random.Generator) -> NDArray[Any]:
    """Colours [rays, 3] float32 behind rays, see `plain_colour`."""
    colour = plain_colour(name)
    if colour is None:
        return rng.random((rays, 3), np.float32)
    return np.broadcast_to(colour.astype(np.float32) / 255, (rays, 3)).copy()


def over(target: Any, background: Any = 1.0) -> tuple[Any, Any]:
    """Images' straight-alpha pixels [N, 4] in [0, 1] over a background [N, 3] (1: white): colour [N, 3] and alpha [N]."""
    alpha = target[:, 3:]
    return target[:, :3] * alpha + (1 - alpha) * background, alpha[:, 0]


def mse_to_psnr(error: float) -> float:
    """PSNR in dB of a mean squared error of colours in [0, 1]; 100 dB at most, so that an error of 0 stays finite (hard case 30)."""
    return -10 * math.log10(max(error, 1e-10))
