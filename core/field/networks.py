"""The view-dependence network: a pure function on arrays, the same for NumPy and JAX."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

VIEW_DEGREES = 4  # sin and cos of 2^0 .. 2^3 times the direction
FEATURES = 4


class ViewNetwork(NamedTuple):
    """Weights of MLP_Phi (section 4.2): 34 -> 16 -> 16 -> 3, kernels [in, out], biases [out], float32."""

    weights_0: Any
    bias_0: Any
    weights_1: Any
    bias_1: Any
    weights_2: Any
    bias_2: Any


SHAPES = ((34, 16), (16,), (16, 16), (16,), (16, 3), (3,))


def view_encoding(xnp: Any, directions: Any) -> Any:
    """[N, 3] unit directions to [N, 27]: d, sin(2^k d), cos(2^k d), k = 0..3, k outermost (the reference's order)."""
    scaled = xnp.concatenate([directions * float(2**k) for k in range(VIEW_DEGREES)], axis=-1)
    return xnp.concatenate([directions, xnp.sin(scaled), xnp.cos(scaled)], axis=-1)


def view_residual(xnp: Any, network: ViewNetwork, colour: Any, features: Any, directions: Any) -> Any:
    """The colour [N, 3] in [0, 1] that view dependence adds (eq. 7).

    colour: [N, 3] composited over white; features: [N, 4] composited; directions: [N, 3] unit, world axes.
    """
    x = xnp.concatenate([view_encoding(xnp, directions), colour, features], axis=-1)
    x = xnp.maximum(x @ network.weights_0 + network.bias_0, 0)
    x = xnp.maximum(x @ network.weights_1 + network.bias_1, 0)
    x = x @ network.weights_2 + network.bias_2
    return 1 / (1 + xnp.exp(-xnp.clip(x, -30, 30)))


def as_numpy(network: ViewNetwork) -> ViewNetwork:
    """Float32 NumPy copies of the six arrays."""
    return ViewNetwork(*(np.asarray(a, np.float32) for a in network))
