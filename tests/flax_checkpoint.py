"""Reference checkpoints written byte by byte, as flax packs them."""

from __future__ import annotations

from pathlib import Path

import msgpack
import numpy as np

from snerg.core.field.positional import init_trunk

VIEW_SHAPES = ((34, 16), (16, 16), (16, 1), (16, 3))


def packed(array: object) -> msgpack.ExtType:
    """An array as flax packs it."""
    array = np.asarray(array)
    return msgpack.ExtType(1, msgpack.packb((array.shape, array.dtype.name, array.tobytes())))


def networks(random: np.random.Generator, width: int = 16, depth: int = 8) -> dict:
    """Four networks of plain arrays, named as the reference names them."""
    result = {}
    for number in range(4):
        if number % 2 == 0:
            layers = [(layer.kernel, layer.bias + 0.1) for layer in init_trunk(random, width, depth)]
        else:
            layers = [(random.normal(size=s).astype("f4") / 4, random.normal(size=s[1]).astype("f4")) for s in VIEW_SHAPES]
        result[f"MLP_{number}"] = {f"Dense_{i}": {"kernel": kernel, "bias": bias} for i, (kernel, bias) in enumerate(layers)}
    return result


def tree(arrays: dict, pack=packed) -> dict:
    """`networks` as the whole checkpoint's tree."""
    params = {n: {d: {k: pack(v) for k, v in dense.items()} for d, dense in layers.items()} for n, layers in arrays.items()}
    state = {"step": packed(np.int32(7)), "param_states": {"anything": packed(np.zeros(3, "f4"))}}
    return {"optimizer": {"target": {"params": params}, "state": state}}


def write(path: Path, value: object) -> Path:
    """Pack `value` into the file `path`."""
    path.write_bytes(msgpack.packb(value))
    return path
