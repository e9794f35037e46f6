"""From what a field holds to the colour of a ray, for every kind of view dependence; NumPy and JAX alike."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from .model import ModelConfig, ViewNetwork, sigmoid, view_encoding, view_head, view_residual

NETWORK_OPAQUE = 1 / 255  # the view-dependence network counts where alpha is at least this (hard case 43)


def unit(directions: NDArray[Any]) -> NDArray[Any]:
    """[N, 3] directions of length 1, as view dependence wants them (hard case 11). Raises SnergError where one has no direction."""
    length = np.linalg.norm(np.asarray(directions, np.float64), axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise SnergError("A viewing direction is zero or not finite; check the poses of the cameras.")
    return np.asarray(directions / length)


def sample_values(xnp: Any, view: str, family: ModelConfig, params: dict[str, Any], values: Any, directions: Any) -> Any:
    """What is composited of samples [N, C], from what `field_outputs` says of them.

    RGB [N, 3] as seen along directions [N, 3] (unit) where view dependence is a sample's own, 'sample' (section 4.1) or 'tiny'
    (supplement C.4); else the values as they are. params: those of `init_field`.
    """
    if view == "tiny":
        colour = values[:, :3]
        return colour + view_residual(xnp, ViewNetwork(*params["view"]), colour, values[:, 3:], directions)
    head = view_head(family, params["field"]) if view == "sample" else None
    if head is None:
        return values
    hidden, rgb = head
    x = xnp.concatenate([values, view_encoding(xnp, directions)], axis=-1)
    x = xnp.maximum(x @ hidden.kernel + hidden.bias, 0)
    return sigmoid(xnp, x @ rgb.kernel + rgb.bias)


def ray_colour(
    xnp: Any, view: str, params: dict[str, Any], gathered: Any, transmittance: Any, directions: Any, background: Any = 1.0
) -> Any:
    """Colour [R, 3] of rays over a background [R, 3] (1: white), from what they gather [R, C] (eqs. 5 to 7).

    directions: [R, 3] unit. The network of a deferred field sees the colour over white, whatever is behind.
    """
    through = transmittance[:, None]
    colour = gathered[:, :3] + through * background
    if view not in ("deferred", "auto"):
        return colour
    residual = view_residual(xnp, ViewNetwork(*params["view"]), gathered[:, :3] + through, gathered[:, 3:], directions)
    return colour + xnp.where(through <= 1 - NETWORK_OPAQUE, residual, 0)
