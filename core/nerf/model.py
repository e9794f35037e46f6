"""The field families and their view dependence: pure functions on arrays, the same for NumPy and JAX."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .hash_grid import HashGrid, hash_encode, hash_lookup
from .mlp import FEATURES, POINT_DEGREES, SKIP, Dense, init_dense, init_trunk, trunk

VIEW_DEGREES = 4  # sin and cos of 2^0 .. 2^3 times the direction
VIEWS = ("deferred", "diffuse", "sample", "tiny")
"""Where a field's view dependence is: in a small network a ray (section 4.2), nowhere, in NeRF's layers a sample (section 4.1),
or in the small network a sample ("JAXNeRF+ Tinyview", supplement C.4)."""


class ViewNetwork(NamedTuple):
    """Weights of MLP_Phi (section 4.2): 34 -> 16 -> 16 -> 3, kernels [in, out], biases [out], float32."""

    weights_0: Any
    bias_0: Any
    weights_1: Any
    bias_1: Any
    weights_2: Any
    bias_2: Any


SHAPES = ((34, 16), (16,), (16, 16), (16,), (16, 3), (3,))
ENCODED_VIEW = 3 * (1 + 2 * VIEW_DEGREES)


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


def with_frequencies(params: dict[str, Any], degrees: int) -> dict[str, Any]:
    """Parameters, or their gradient, in which the view-dependence networks use only the first `degrees` frequencies of the direction's
    encoding (0 to VIEW_DEGREES): the weights of the other frequencies are set to 0."""
    changed = dict(params)
    if "view" in params and degrees < VIEW_DEGREES:
        first, *rest = params["view"]
        row = np.arange(first.shape[0])
        seen = (row < 3) | (row >= ENCODED_VIEW) | ((row - 3) // 3 % VIEW_DEGREES < degrees)
        changed["view"] = (first * seen[:, None].astype(np.float32), *rest)
    if "coarse" in params:
        changed["coarse"] = with_frequencies(params["coarse"], degrees)
    return changed


def as_numpy(network: ViewNetwork) -> ViewNetwork:
    """Float32 NumPy copies of the six arrays."""
    return ViewNetwork(*(np.asarray(a, np.float32) for a in network))


@dataclass(frozen=True)
class HashModelConfig:
    """A hash grid and one small hidden layer: trains in minutes on a CPU."""

    grid: HashGrid = HashGrid()
    width: int = 64


@dataclass(frozen=True)
class MlpModelConfig:
    """The paper's positional-encoding MLP (section 6; see mlp.py).

    density: 'softplus' trains from every initialisation (hard case 24); 'relu' is what reference checkpoints have.
    """

    width: int = 512
    depth: int = 8
    skip: int = SKIP
    degrees: int = POINT_DEGREES
    density: str = "softplus"


ModelConfig = HashModelConfig | MlpModelConfig


def init_params(family: ModelConfig, view: str, coarse: bool, rng: np.random.Generator) -> dict[str, Any]:
    """Random parameters of all that is trained, NumPy: `init_field`, and the same again as "coarse" where that is asked for."""
    params = init_field(family, view, rng)
    return params | {"coarse": init_field(family, view, rng)} if coarse else params


def init_field(family: ModelConfig, view: str, rng: np.random.Generator) -> dict[str, Any]:
    """Random parameters as NumPy arrays: {"field": ..., "view": six arrays} ("view" only where there is a MLP_Phi).

    view: one of VIEWS, or 'auto', which has the arrays of 'deferred'. A diffuse field's arrays are those of a deferred one
    without the last columns of its last head, so that the one can be cut out of the other.
    """
    outputs = {"diffuse": 3, "sample": family.width}.get(view, 3 + FEATURES)
    params: dict[str, Any] = {
        "field": _init_hash(family, outputs, rng) if isinstance(family, HashModelConfig) else _init_mlp(family, outputs, rng)
    }
    if view == "sample":
        params["field"] = _with_head(params["field"], family.width, rng)
    elif view != "diffuse":
        kernels = [init_dense(rng, *shape).kernel if len(shape) == 2 else np.zeros(shape, np.float32) for shape in SHAPES]
        kernels[5] -= 3.0  # the residual starts near 0, and diffuse colour explains what it can first
        params["view"] = tuple(kernels)
    return params


def _init_hash(family: HashModelConfig, outputs: int, rng: np.random.Generator) -> dict[str, Any]:
    grid, width = family.grid, family.width
    tables = {f"table_{i}": rng.uniform(-1e-4, 1e-4, size * grid.features).astype(np.float32) for i, size in enumerate(grid.sizes.tolist())}
    layers = [init_dense(rng, grid.levels * grid.features, width), init_dense(rng, width, 1 + outputs)]
    return tables | {f"{part}_{i}": a for i, layer in enumerate(layers) for part, a in zip(("weights", "bias"), layer, strict=True)}


def _init_mlp(family: MlpModelConfig, outputs: int, rng: np.random.Generator) -> Any:
    return init_trunk(rng, family.width, family.depth, family.degrees, family.skip, outputs)


def _with_head(params: Any, width: int, rng: np.random.Generator) -> Any:
    """NeRF's view dependence: a layer of half the width over the bottleneck and the encoded direction, then RGB."""
    hidden, rgb = init_dense(rng, width + ENCODED_VIEW, max(width // 2, 1)), init_dense(rng, max(width // 2, 1), 3)
    if not isinstance(params, dict):
        return (*params, hidden, rgb)
    return params | {"weights_2": hidden.kernel, "bias_2": hidden.bias, "weights_3": rgb.kernel, "bias_3": rgb.bias}


def view_head(family: ModelConfig, params: Any) -> tuple[Dense, Dense] | None:
    """The two layers a sample of a field with view dependence 'sample'; None in any other field."""
    if isinstance(family, HashModelConfig):
        if "weights_2" not in params:
            return None
        return Dense(params["weights_2"], params["bias_2"]), Dense(params["weights_3"], params["bias_3"])
    layers = params[family.depth + 2 :]
    return (layers[0], layers[1]) if layers else None


def field_inputs(xnp: Any, family: ModelConfig, x: Any) -> Any:
    """The inputs of `field_outputs` for points [N, 3] in field coordinates: what depends on the points alone and not on the parameters.

    A hash grid's (indices, weights), see `hash_lookup`; an MLP's points themselves.
    """
    if isinstance(family, HashModelConfig):
        return hash_lookup(xnp, family.grid, xnp.clip(x * 0.5 + 0.5, 0, 1))
    return x


def field_outputs(xnp: Any, family: ModelConfig, params: Any, inputs: Any) -> tuple[Any, Any]:
    """(density [N] per unit of the field's own coordinates, values [N, C]) (eq. 4).

    values: RGB and features [N, 7] in [0, 1], RGB alone [N, 3] of a diffuse field; with view dependence 'sample' NeRF's bottleneck
    [N, width], which has no activation.
    """
    raw, values = raw_outputs(xnp, family, params, inputs)
    return density_of(xnp, family, raw), values


def raw_outputs(xnp: Any, family: ModelConfig, params: Any, inputs: Any) -> tuple[Any, Any]:
    """(raw density [N], values [N, C]): as `field_outputs`, but without the density's activation (`density_of`).

    inputs: the result of `field_inputs`. params: params["field"] of `init_field`. The values have their activation.
    """
    if isinstance(family, HashModelConfig):
        tables = [params[f"table_{i}"] for i in range(family.grid.levels)]
        hidden = xnp.maximum(hash_encode(xnp, family.grid, tables, *inputs) @ params["weights_0"] + params["bias_0"], 0)
        raw = hidden @ params["weights_1"] + params["bias_1"]
        density, values = raw[:, 0], raw[:, 1:]
    else:
        density, values = trunk(xnp, params[: family.depth + 2], inputs, family.degrees, family.skip)
    return density, values if view_head(family, params) else sigmoid(xnp, values)


def density_of(xnp: Any, family: ModelConfig, raw: Any) -> Any:
    """Density [N] >= 0, per unit of field coordinates, from the network's raw output [N]: exponential, ReLU or softplus."""
    if isinstance(family, HashModelConfig):
        return bounded_exp(xnp, raw)
    if family.density == "relu":
        return xnp.maximum(raw, 0)
    return xnp.logaddexp(raw + 1, 0) * 8


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
