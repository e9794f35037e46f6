"""The field families and the view-dependence network: pure functions on arrays, the same for NumPy and JAX."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .encoding import HashGrid, hash_encode, hash_lookup
from .positional import FEATURES, POINT_DEGREES, SKIP, init_trunk, trunk

VIEW_DEGREES = 4  # sin and cos of 2^0 .. 2^3 times the direction


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
    return sigmoid(xnp, x)


def as_numpy(network: ViewNetwork) -> ViewNetwork:
    """Float32 NumPy copies of the six arrays."""
    return ViewNetwork(*(np.asarray(a, np.float32) for a in network))


@dataclass(frozen=True)
class HashFamily:
    """A hash grid and one small hidden layer: trains in minutes on a CPU."""

    grid: HashGrid = HashGrid()
    width: int = 64


@dataclass(frozen=True)
class MlpFamily:
    """The paper's positional-encoding MLP (section 6; see positional.py).

    density: 'softplus' trains from every initialisation (hard case 24); 'relu' is what reference checkpoints have.
    """

    width: int = 512
    depth: int = 8
    skip: int = SKIP
    degrees: int = POINT_DEGREES
    density: str = "softplus"


Family = HashFamily | MlpFamily
HEADS = 1 + 3 + FEATURES  # density, RGB, features


def init_field(family: Family, view_dependence: bool, rng: np.random.Generator) -> dict[str, Any]:
    """Random parameters as NumPy arrays: {"field": ..., "view": six arrays} ("view" only with view dependence)."""
    if isinstance(family, HashFamily):
        params: dict[str, Any] = {"field": _init_hash(family, rng)}
    else:
        params = {"field": init_trunk(rng, family.width, family.depth, family.degrees, family.skip)}
    if view_dependence:
        kernels = [glorot(rng, *shape) if len(shape) == 2 else np.zeros(shape, np.float32) for shape in SHAPES]
        kernels[5] -= 3.0  # the residual starts near 0, and diffuse colour explains what it can first
        params["view"] = tuple(kernels)
    return params


def glorot(rng: np.random.Generator, fan_in: int, fan_out: int) -> np.ndarray:
    """[fan_in, fan_out] float32, uniform (Glorot and Bengio 2010)."""
    limit = np.sqrt(6 / (fan_in + fan_out))
    return rng.uniform(-limit, limit, (fan_in, fan_out)).astype(np.float32)


def _init_hash(family: HashFamily, rng: np.random.Generator) -> dict[str, Any]:
    grid, width = family.grid, family.width
    return {
        "table": rng.uniform(-1e-4, 1e-4, (grid.rows, grid.features)).astype(np.float32),
        "weights_0": glorot(rng, grid.levels * grid.features, width),
        "bias_0": np.zeros(width, np.float32),
        "weights_1": glorot(rng, width, HEADS),
        "bias_1": np.zeros(HEADS, np.float32),
    }


def field_inputs(xnp: Any, family: Family, x: Any) -> Any:
    """What `field_outputs` needs of points [N, 3] in the field's own coordinates, computed apart from the parameters (see hash_lookup)."""
    if isinstance(family, HashFamily):
        return hash_lookup(xnp, family.grid, xnp.clip(x * 0.5 + 0.5, 0, 1))
    return x


def field_outputs(xnp: Any, family: Family, params: Any, inputs: Any) -> tuple[Any, Any]:
    """(density [N] per unit of the field's own coordinates, RGB and features [N, 7] in [0, 1]) (eq. 4)."""
    if isinstance(family, HashFamily):
        hidden = xnp.maximum(hash_encode(params["table"], *inputs) @ params["weights_0"] + params["bias_0"], 0)
        raw = hidden @ params["weights_1"] + params["bias_1"]
        return bounded_exp(xnp, raw[:, 0]), sigmoid(xnp, raw[:, 1:])
    raw_density, raw = trunk(xnp, params, inputs, family.degrees, family.skip)
    if family.density == "relu":
        return xnp.maximum(raw_density, 0), sigmoid(xnp, raw)
    return xnp.logaddexp(raw_density + 1, 0) * 8, sigmoid(xnp, raw)


def sigmoid(xnp: Any, x: Any) -> Any:
    """Logistic function that stays finite: beyond 30 it is 0 or 1 in float32 anyway."""
    return 1 / (1 + xnp.exp(-xnp.clip(x, -30, 30)))


def bounded_exp(xnp: Any, x: Any) -> Any:
    """exp of x held between -15 and 10, whose gradient beyond those bounds is the one at them (hard case 25).

    e^10 a domain of length 2 is opaque within a voxel of a 1000^3 grid. A gradient of 0 out there would leave a density
    that drifted past the bound there for good.
    """
    value = xnp.exp(xnp.clip(x, -15, 10))
    if xnp is np:
        return value
    from jax.lax import stop_gradient

    return stop_gradient(value) * (1 + (x - stop_gradient(x)))
