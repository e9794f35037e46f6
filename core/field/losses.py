"""Losses of training (eqs. 3 and 8)."""

from __future__ import annotations

import math
from typing import Any


def cauchy(xnp: Any, density: Any, c: float = 0.5) -> Any:
    """log(1 + density^2 / c), elementwise (eq. 8, c = 1/2).

    Where the square would overflow, its limit 2 log(density) - log(c) (hard case 23).
    """
    large = density > 1e6
    small = xnp.where(large, 1.0, density)  # the branch not taken must have a finite gradient too
    big = xnp.where(large, density, 1.0)
    return xnp.where(large, 2 * xnp.log(big) - math.log(c), xnp.log1p(small * small / c))
