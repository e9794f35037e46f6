"""Opacity correction of composited rays (eq. 9)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..nerf.frame import Composited


def correct_opacity(rays: Composited) -> Composited:
    """Rays with 1.5 times the opacity, at most 1, and colour, features and depth scaled alike (eq. 9).

    It makes up for the transmittance that baking leaves in surfaces.
    """
    alpha = 1 - rays.transmittance
    factor = opacity_factor(np, alpha)
    transmittance = np.maximum(1 - factor * alpha, 0)
    return Composited(rays.colour * factor[:, None], rays.features * factor[:, None], transmittance, rays.depth * factor, rays.samples)


def opacity_factor(xnp: Any, alpha: Any) -> Any:
    """What eq. 9 multiplies an opacity with, float32, elementwise. The same formula serves NumPy and JAX.

    The factor min(1, 1.5 alpha) / alpha is written so that it is finite at alpha = 0 and continuous at 2/3, from which a ray is opaque
    (hard case 53).
    """
    return xnp.where(alpha < 2 / 3, 1.5, 1 / xnp.maximum(alpha, 2 / 3)).astype(xnp.float32)
