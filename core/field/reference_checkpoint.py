"""Checkpoints of the reference implementation: msgpack as flax writes it, read without flax.

A checkpoint holds four networks, MLP_0 .. MLP_3: coarse trunk, coarse view network, fine trunk, fine view network.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ..errors import SnergError
from .field import Field
from .networks import SHAPES, MlpFamily, ViewNetwork, view_residual
from .positional import Dense, Trunk, layer_shapes, mlp_field
from .sampling import Domain

MAX_BYTES = 2**29  # a deferred NeRF of the paper's size is 15 MB with its optimiser
NDARRAY, SCALAR = 1, 3  # flax's msgpack extension types
KINDS = ("float16", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "bool")
VIEW_LAYERS = (0, 1, 3)  # Dense_2 of a view network is a density that nothing uses
REACH = 1.5  # what the reference's scenes keep to on every axis; a checkpoint does not say
SAMPLES_ACROSS = 512  # of that extent, when the field itself is rendered


@dataclass(frozen=True, eq=False)
class ReferenceCheckpoint:
    """The networks of a deferred NeRF as the reference trained it; arrays float32, positions in its world's units.

    trunk, network: the fine pair, which is what is baked. coarse_trunk, coarse_network: the coarse pair.
    """

    step: int
    trunk: Trunk
    network: ViewNetwork
    coarse_trunk: Trunk
    coarse_network: ViewNetwork


def find_checkpoint(path: Path) -> Path | None:
    """`path` itself, or the newest checkpoint_<step> in the folder `path`; None where there is none."""
    if not path.is_dir():
        return path if path.is_file() else None
    steps = {int(match[1]): p for p in path.iterdir() if p.is_file() and (match := re.fullmatch(r"checkpoint_(\d+)", p.name))}
    return steps[max(steps)] if steps else None


def read_reference_checkpoint(path: Path) -> ReferenceCheckpoint:
    """Read checkpoint_<step>, or the newest one in a folder.

    Raises SnergError when there is none, when it is cut short or no deferred NeRF, or names the tensor that is not finite.
    """
    found = find_checkpoint(Path(path))
    if found is None:
        raise SnergError(f"There is no checkpoint at {path}; give a checkpoint_<step> file, or the folder that holds it.")
    optimizer = _mapping(_unpack(found), "optimizer", found)
    networks = _mapping(_mapping(_mapping(optimizer, "target", found), "params", found), "", found)
    if sorted(networks) != ["MLP_0", "MLP_1", "MLP_2", "MLP_3"]:
        raise SnergError(f"{found} holds {', '.join(sorted(networks)[:8]) or 'nothing'}, not the four networks of a deferred NeRF.")
    return ReferenceCheckpoint(
        step=_step(optimizer, found),
        trunk=_trunk(networks, "MLP_2", found),
        network=_view_network(networks, "MLP_3", found),
        coarse_trunk=_trunk(networks, "MLP_0", found),
        coarse_network=_view_network(networks, "MLP_1", found),
    )


def reference_mlp(xnp: Any, checkpoint: ReferenceCheckpoint, points: Any, directions: Any) -> tuple[Any, Any, Any, Any]:
    """The fine networks at positions [N, 3] and unit directions [N, 3].

    Returns (density [N], RGB [N, 3], features [N, 4], residual [N, 3]), the residual as of a ray that gathers just this point.
    """
    density, colour, features = mlp_field(xnp, checkpoint.trunk, points)
    return density, colour, features, view_residual(xnp, checkpoint.network, colour, features, directions)


def field_of(checkpoint: ReferenceCheckpoint, source: str) -> Field:
    """The fine networks as a field, to bake: its coordinates are the world's, and it fills [-1.5, 1.5]^3.

    A checkpoint knows neither its cameras nor its images, so nothing can be culled by visibility or refined.
    """
    trunk, reach = checkpoint.trunk, np.full(3, REACH)
    family = MlpFamily(width=trunk[0].kernel.shape[1], depth=len(trunk) - 2, density="relu")
    return Field(
        family=family,
        params=trunk,
        network=checkpoint.network,
        domain=Domain(np.zeros(3), 1.0, -reach, reach),
        occupancy=None,
        spacing=2 * REACH / SAMPLES_ACROSS,
        about={"source": source, "family": type(family).__name__, "steps": checkpoint.step},
    )


def _unpack(path: Path) -> Any:
    """The file's tree, with arrays left as `_Packed` until they are asked for."""
    import msgpack

    try:
        if path.stat().st_size > MAX_BYTES:
            raise SnergError(f"{path} is larger than {MAX_BYTES >> 20} MiB; it cannot be the checkpoint of a deferred NeRF.")
        data = path.read_bytes()
    except OSError as error:
        raise SnergError(f"Cannot read {path} ({error.strerror}).") from error
    try:
        return msgpack.unpackb(data, ext_hook=_Packed, strict_map_key=False)
    except Exception as error:  # msgpack raises half a dozen kinds, ValueError to its own StackError
        raise SnergError(f"{path} is not a checkpoint, or is cut short ({error}); copy it again.") from error


@dataclass(frozen=True)
class _Packed:
    """An extension value of the file, not yet believed."""

    code: int
    data: bytes

    def array(self) -> np.ndarray:
        """Decode an array or a scalar. Raises ValueError on anything that does not add up."""
        import msgpack

        if self.code not in (NDARRAY, SCALAR):
            raise ValueError(f"extension type {self.code}")
        shape, kind, raw = msgpack.unpackb(self.data, raw=True)
        name = kind.decode("ascii", "replace")
        if name not in KINDS:
            raise ValueError(f"values of type {name}")
        values = np.frombuffer(raw, np.dtype(name))
        if not all(isinstance(n, int) and n >= 0 for n in shape):
            raise ValueError(f"shape {shape}")
        return values.reshape(shape)


def _array(value: Any) -> np.ndarray:
    """An array, whole or in chunks (flax splits what is over 2^30 bytes). Raises ValueError."""
    if isinstance(value, Mapping) and "__msgpack_chunked_array__" in value:
        chunks = [_array(chunk) for chunk in _listed(value["chunks"])]
        return np.concatenate([chunk.reshape(-1) for chunk in chunks]).reshape([int(n) for n in _listed(value["shape"])])
    if not isinstance(value, _Packed):
        raise ValueError(f"{type(value).__name__} where an array should be")
    return value.array()


def _listed(value: Any) -> list[Any]:
    """flax writes a tuple as {"0": ..., "1": ...}."""
    return [value[str(i)] for i in range(len(value))] if isinstance(value, Mapping) else list(value)


def _mapping(value: Any, name: str, path: Path) -> Mapping[str, Any]:
    inner = value.get(name) if name and isinstance(value, Mapping) else value
    if not isinstance(inner, Mapping):
        raise SnergError(f"{path} is not a checkpoint of a deferred NeRF: it has no {name or 'parameters'}.")
    return inner


def _step(optimizer: Mapping[str, Any], path: Path) -> int:
    step = _mapping(optimizer, "state", path).get("step", 0)
    try:
        return int(step if isinstance(step, int) else _array(step))
    except (ValueError, TypeError) as error:
        raise SnergError(f"{path} has a damaged step ({error}); copy it again.") from error


def _tensor(networks: Mapping[str, Any], network: str, layer: int, part: str, path: Path) -> np.ndarray:
    """float32 copy of one tensor; the error names it (hard case 59)."""
    name = f"{network}/Dense_{layer}/{part}"
    try:
        value = np.array(_array(networks[network][f"Dense_{layer}"][part]), np.float32)
    except Exception as error:  # a damaged file can put anything anywhere, inner msgpack errors included
        raise SnergError(f"{path} has no sound {name} ({type(error).__name__}: {error}); copy it again.") from error
    if not np.isfinite(value).all():
        raise SnergError(f"{path} has values in {name} that are not finite; its training diverged: use an earlier checkpoint.")
    return value


def _dense(networks: Mapping[str, Any], network: str, layer: int, path: Path) -> Dense:
    dense = Dense(*(_tensor(networks, network, layer, part, path) for part in ("kernel", "bias")))
    if dense.kernel.ndim != 2 or dense.bias.shape != dense.kernel.shape[1:]:
        _misshapen(path, f"{network}/Dense_{layer}", (dense.kernel.shape, dense.bias.shape))
    return dense


def _trunk(networks: Mapping[str, Any], name: str, path: Path) -> Trunk:
    """A trunk of any width and depth; its shapes must be those of `layer_shapes`."""
    count = len(_mapping(networks, name, path))
    layers = tuple(_dense(networks, name, layer, path) for layer in range(count))
    if count < 3:
        _misshapen(path, name, f"{count} layers")
    expected = layer_shapes(layers[0].kernel.shape[1], count - 2)
    for i, (layer, shape) in enumerate(zip(layers, expected, strict=True)):
        if layer.kernel.shape != shape:
            _misshapen(path, f"{name}/Dense_{i}", f"{layer.kernel.shape}, not {shape}")
    return layers


def _view_network(networks: Mapping[str, Any], name: str, path: Path) -> ViewNetwork:
    _mapping(networks, name, path)
    network = ViewNetwork(*(array for layer in VIEW_LAYERS for array in _dense(networks, name, layer, path)))
    for array, shape in zip(network, SHAPES, strict=True):
        if array.shape != shape:
            _misshapen(path, name, f"{array.shape}, not {shape}")
    return network


def _misshapen(path: Path, name: str, what: object) -> NoReturn:
    raise SnergError(f"{path} is not a checkpoint of a deferred NeRF that SNeRG knows: {name} is {what}.")
