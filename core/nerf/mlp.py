"""The paper's field: positional encoding and a multi-layer perceptron (section 4.2), pure functions on pytrees.

`xnp` is numpy or jax.numpy, so that one formula serves training, imported checkpoints and tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

FEATURES = 4
POINT_DEGREES = 10  # sin and cos of 2^0 .. 2^9 times the position
SKIP = 4  # the encoding is fed in again after layers 4, 8, ...
OUTPUTS = 3 + FEATURES  # RGB and features


class Dense(NamedTuple):
    """One layer: kernel [in, out], bias [out], float32."""

    kernel: Any
    bias: Any


Trunk = tuple[Dense, ...]
"""The hidden layers in order, then the density head [W, 1], then the head of the other outputs: RGB and features [W, 7]."""


def positional_encoding(xnp: Any, x: Any, degrees: int = POINT_DEGREES) -> Any:
    """[N, D] to [N, D * (1 + 2 * degrees)]: x, sin(2^k x), cos(2^k x), k = 0 .. degrees - 1, k outermost.

    The cosine is a cosine: the reference's sin(x + pi / 2) loses digits (hard case 12). Multiplying by a power
    of two is exact, so the coordinate's own rounding is all that is left (hard case 13).
    """
    if degrees == 0:
        return x
    scaled = xnp.concatenate([x * float(2**k) for k in range(degrees)], axis=-1)
    return xnp.concatenate([x, xnp.sin(scaled), xnp.cos(scaled)], axis=-1)


def trunk(xnp: Any, layers: Sequence[Dense], x: Any, degrees: int = POINT_DEGREES, skip: int = SKIP) -> tuple[Any, Any]:
    """Evaluate the perceptron at positions [N, 3]: (raw density [N], raw other outputs [N, 7]), before their activations."""
    inputs = positional_encoding(xnp, x, degrees)
    x = inputs
    for i, layer in enumerate(layers[:-2]):
        x = xnp.maximum(x @ layer.kernel + layer.bias, 0)
        if i > 0 and i % skip == 0:
            x = xnp.concatenate([x, inputs], axis=-1)
    density, outputs = layers[-2:]
    return (x @ density.kernel + density.bias)[..., 0], x @ outputs.kernel + outputs.bias


def activate(xnp: Any, raw_density: Any, raw_outputs: Any) -> tuple[Any, Any, Any]:
    """(density [N], RGB [N, 3], features [N, 4]) from raw outputs: ReLU and sigmoid, as the reference trains them."""
    values = 1 / (1 + xnp.exp(-xnp.clip(raw_outputs, -30, 30)))
    return xnp.maximum(raw_density, 0), values[..., :3], values[..., 3:]


def mlp_field(xnp: Any, layers: Sequence[Dense], points: Any, degrees: int = POINT_DEGREES) -> tuple[Any, Any, Any]:
    """Positions [N, 3] to (density [N] per unit of the positions' length, RGB [N, 3], features [N, 4])."""
    return activate(xnp, *trunk(xnp, layers, points, degrees))


def layer_shapes(
    width: int, depth: int, degrees: int = POINT_DEGREES, skip: int = SKIP, outputs: int = OUTPUTS
) -> tuple[tuple[int, int], ...]:
    """Kernel shapes [in, out] of a trunk: `depth` hidden layers of `width` units, then the density head and the head of the outputs."""
    encoded = 3 * (1 + 2 * degrees)
    shapes, size = [], encoded
    for i in range(depth):
        shapes.append((size, width))
        size = width + encoded if i > 0 and i % skip == 0 else width
    return (*shapes, (size, 1), (size, outputs))


def init_trunk(
    random: np.random.Generator,
    width: int = 256,
    depth: int = 8,
    degrees: int = POINT_DEGREES,
    skip: int = SKIP,
    outputs: int = OUTPUTS,
) -> Trunk:
    """Random initial layers of a perceptron; a generator in the same state gives the same bytes."""
    return tuple(init_dense(random, *shape) for shape in layer_shapes(width, depth, degrees, skip, outputs))


def init_dense(random: np.random.Generator, rows: int, columns: int) -> Dense:
    """Random initial weights of a layer [rows, columns]: uniform as in Glorot and Bengio 2010, as in JAXNeRF; biases are 0."""
    reach = np.sqrt(6 / (rows + columns))
    return Dense(random.uniform(-reach, reach, (rows, columns)).astype(np.float32), np.zeros(columns, np.float32))
