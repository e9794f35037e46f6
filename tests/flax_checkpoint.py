"""Reference checkpoints written byte by byte, as flax packs them, and what their networks give, restated plainly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgpack
import numpy as np


def packed(array: object) -> msgpack.ExtType:
    """An array as flax packs it."""
    array = np.asarray(array)
    return msgpack.ExtType(1, msgpack.packb((array.shape, array.dtype.name, array.tobytes())))


def mlp(random: np.random.Generator, inputs: int, outputs: int, width: int, depth: int, skip: int) -> dict:
    """The reference's MLP: `depth` layers, the inputs fed in again after every `skip`-th, then a density and the outputs."""
    rows, shapes = inputs, []
    for i in range(depth):
        shapes.append((rows, width))
        rows = width + inputs if i > 0 and i % skip == 0 else width
    shapes += [(rows, 1), (rows, outputs)]
    return {
        f"Dense_{i}": {"kernel": np.float32(random.normal(size=s) / np.sqrt(s[0])), "bias": np.float32(random.normal(size=s[1]) / 4 + 0.1)}
        for i, s in enumerate(shapes)
    }


def networks(
    random: np.random.Generator,
    width: int = 16,
    depth: int = 8,
    skip: int = 4,
    degrees: int = 10,
    features: int = 4,
    view: tuple[int, int, int] | None = (16, 2, 4),
    fine: bool = True,
) -> dict:
    """Networks of plain arrays, named as the reference names them. view: (width, depth, degrees), None without view directions."""
    result: dict[str, Any] = {}
    for _ in range(2 if fine else 1):
        result[f"MLP_{len(result)}"] = mlp(random, 3 + 6 * degrees, 3 + features, width, depth, skip)
        if view is not None:
            result[f"MLP_{len(result)}"] = mlp(random, 3 + 6 * view[2] + 3 + features, 3, view[0], view[1], skip)
    return result


def evaluate(network: dict, x: np.ndarray, skip: int) -> tuple[np.ndarray, np.ndarray]:
    """(raw density [N], raw outputs [N, K]) of an MLP, in float64."""
    layers = [(np.float64(network[f"Dense_{i}"]["kernel"]), np.float64(network[f"Dense_{i}"]["bias"])) for i in range(len(network))]
    inputs = x
    for i, (kernel, bias) in enumerate(layers[:-2]):
        x = np.maximum(x @ kernel + bias, 0)
        if i > 0 and i % skip == 0:
            x = np.concatenate([x, inputs], axis=-1)
    return (x @ layers[-2][0] + layers[-2][1])[:, 0], x @ layers[-1][0] + layers[-1][1]


def encode(x: np.ndarray, degrees: int) -> np.ndarray:
    """x, all its sines, all its cosines, float64."""
    x = np.float64(x)
    angles = [x * 2.0**k for k in range(degrees)]
    return np.concatenate([x, *(np.sin(a) for a in angles), *(np.cos(a) for a in angles)], axis=-1)


def logistic(x: np.ndarray) -> np.ndarray:
    """1 / (1 + e^-x)."""
    return 1 / (1 + np.exp(-x))


def tree(arrays: dict, pack: Any = packed) -> dict:
    """`networks` as the whole checkpoint's tree."""
    params = {n: {d: {k: pack(v) for k, v in dense.items()} for d, dense in layers.items()} for n, layers in arrays.items()}
    state = {"step": packed(np.int32(7)), "param_states": {"anything": packed(np.zeros(3, "f4"))}}
    return {"optimizer": {"target": {"params": params}, "state": state}}


def write(path: Path, value: object) -> Path:
    """Pack `value` into the file `path`."""
    path.write_bytes(msgpack.packb(value))
    return path
