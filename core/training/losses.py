"""Losses of training (eqs. 3 and 8, and one of our own), and background colours."""

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
    """The opacity regulariser w (1 - w), elementwise, of compositing weights w. Method of our own, after priors for hard surfaces.

    Its sum over a ray is 0 where one sample has weight 1, or all have weight 0; it is near the ray's opacity where many samples share it.
    Its slope is at most 1, whereas that of the squared error grows with the error: density that the images need, such as fog, stays,
    and only the depth over which an opaque surface absorbs, which the images do not determine, becomes small.
    """
    return weights * (1 - weights)


def plain_colour(name: str) -> NDArray[Any] | None:
    """The colour, uint8 [3], of the background 'white', 'black' or '#rrggbb'; None for 'random', a new random colour for each ray."""
    value = {"white": "#ffffff", "black": "#000000"}.get(name, name)
    return np.array(list(bytes.fromhex(value[1:])), np.uint8) if re.fullmatch("#[0-9a-fA-F]{6}", value) else None


def shown_over(name: str) -> NDArray[Any]:
    """The background colour, float32 [3] in [0, 1], over which a field is evaluated.

    name: the training's setting `background`. It is the colour of that name; white for 'random'.
    """
    colour = plain_colour(name)
    return np.ones(3, np.float32) if colour is None else colour.astype(np.float32) / 255


def backgrounds(name: str, rays: int, rng: np.random.Generator) -> NDArray[Any]:
    """Background colours [rays, 3] float32 in [0, 1] for training rays; `name`: see `plain_colour`."""
    colour = plain_colour(name)
    if colour is None:
        return rng.random((rays, 3), np.float32)
    return np.broadcast_to(colour.astype(np.float32) / 255, (rays, 3)).copy()


def over(target: Any, background: Any = 1.0) -> tuple[Any, Any]:
    """Composite pixels [N, 4] in [0, 1] with straight alpha over a background [N, 3] (1: white): (colour [N, 3], alpha [N])."""
    alpha = target[:, 3:]
    return target[:, :3] * alpha + (1 - alpha) * background, alpha[:, 0]


def diffuse_error(xnp: Any, colour: Any, diffuse: Any, target: Any) -> Any:
    """The squared error [R] of the composited diffuse colours [R, 3] against the diffuse pass, by the pass's share of each pixel's light.

    diffuse: [R, 3], target: [R, 4], the pixels of the pass and of the picture, uint8 with the picture's straight alpha. The share keeps
    mirrors out, whose diffuse colour is black: there the field's geometry is learned from what they reflect. Method of our own.
    """
    wanted, shown = diffuse.astype(xnp.float32) / 255, target.astype(xnp.float32) / 255
    share = xnp.clip(wanted.sum(axis=-1) / xnp.maximum(shown[:, :3].sum(axis=-1), 1 / 255), 0, 1)
    return share * ((colour - wanted * shown[:, 3:]) ** 2).mean(axis=-1)


def mse_to_psnr(error: float) -> float:
    """PSNR in dB of a mean squared error of colours in [0, 1]; 100 dB at most, so that an error of 0 stays finite (hard case 30)."""
    return -10 * math.log10(max(error, 1e-10))
