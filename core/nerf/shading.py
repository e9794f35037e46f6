"""Colours of samples and of rays from a field's outputs, for every kind of view dependence. The same formulas serve NumPy and JAX."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from .model import ModelConfig, ViewNetwork, sigmoid, view_encoding, view_head, view_residual

NETWORK_OPAQUE = 1 / 255  # the residual is added where alpha is at least this, one level of 8 bits (hard case 43)


def unit(directions: NDArray[Any]) -> NDArray[Any]:
    """Normalise directions [N, 3] to length 1, float64, for the view-dependence network (hard case 11).

    Raises SnergError when one is 0 or not finite.
    """
    length = np.linalg.norm(np.asarray(directions, np.float64), axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise SnergError("A viewing direction is zero or not finite; check the poses of the cameras.")
    return np.asarray(directions / length)


def sample_values(xnp: Any, view: str, family: ModelConfig, params: dict[str, Any], values: Any, directions: Any) -> Any:
    """The values of samples to composite, from the values [N, C] of `field_outputs`.

    With view dependence per sample, 'sample' (section 4.1) or 'tiny' (supplement C.4), this is RGB [N, 3] along the unit view
    directions [N, 3]; otherwise the values are returned as they are. params: the result of `init_field`.
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
    """The colour [R, 3] of rays over a background, display-referred, from their composited values `gathered` [R, C] (eqs. 5 to 7).

    transmittance: [R]. directions: [R, 3] unit view directions. background: [R, 3] or one number (1: white).
    A deferred field adds the residual of its network where alpha is at least NETWORK_OPAQUE. The network's input is the colour over
    white, whatever the background is.
    """
    transmittance = transmittance[:, None]
    colour = gathered[:, :3] + transmittance * background
    if view not in ("deferred", "auto"):
        return colour
    residual = view_residual(xnp, ViewNetwork(*params["view"]), gathered[:, :3] + transmittance, gathered[:, 3:], directions)
    return colour + xnp.where(transmittance <= 1 - NETWORK_OPAQUE, residual, 0)
