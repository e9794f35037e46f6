"""Reads checkpoints of the reference implementation, which are msgpack files written by flax, without flax.

Deferred, a checkpoint holds MLP_0 .. MLP_3: coarse trunk, coarse view network, fine trunk, fine view network. Without
view directions it holds MLP_0 and MLP_1, coarse and fine, or just MLP_0 when there were no fine samples. Width, depth,
skips and degrees of the encoding are read off the tensors' shapes. What the shapes do not show is taken as the reference's
default: degrees from 0, sines before cosines, ReLU.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.guard import check_file, reading
from ..io.schema import FAR
from .field import Field
from .mlp import FEATURES, Dense, Trunk, activate, trunk
from .model import SHAPES, VIEW_DEGREES, MlpModelConfig, ViewNetwork, view_residual
from .sampling import Domain

MAX_BYTES = 2**29  # a deferred NeRF of the paper's size is 50 MB with its optimiser
LIMITS = {"max_array_len": 64, "max_map_len": 4096, "max_str_len": 4096}  # or a few bytes could ask for gigabytes of list
NDARRAY, SCALAR = 1, 3  # flax's msgpack extension types
KINDS = ("float16", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "bool")
# The networks that a checkpoint holds, to those that are baked: trunk and view network.
BAKED = {
    ("MLP_0", "MLP_1", "MLP_2", "MLP_3"): ("MLP_2", "MLP_3"),
    ("MLP_0", "MLP_1"): ("MLP_1", None),
    ("MLP_0",): ("MLP_0", None),
}
OTHER_FILES = (
    (rb"PK\x03\x04", "a zip archive, as PyTorch and NumPy write"),
    (rb"\x80[\x02-\x05]", "a pickle, which can run programs when it is opened and so never is here"),
    (rb"\x89HDF", "an HDF5 file"),
    (rb"\x93NUMPY", "a NumPy array"),
    (rb"\s*[\[{]", "JSON"),
)
BOX_SCALE = 1.7  # half the side of the cube that is baked: the default of snerg_box_scale in the reference's configuration
BOX_SCALE_LINE = re.compile(rb"^snerg_box_scale\s*:\s*([0-9.eE+-]+)\s*(?:#.*)?$", re.MULTILINE)  # in a configuration, YAML
MAX_CONFIGURATION = 2**16  # bytes of a configuration; the published ones have 500
ORBAX_MARKS = ("_CHECKPOINT_METADATA", "_METADATA", "manifest.ocdbt", "checkpoint")  # files of a checkpoint that Orbax wrote
PLACES = (
    ("optimizer", "target", "params"),
    ("target", "params"),
    ("params", "params"),
    ("params",),
    (),
)  # of the networks: flax's, old to new
SAMPLES_ACROSS = 512  # of that extent, when the field itself is rendered


@dataclass(frozen=True, eq=False)
class ReferenceCheckpoint:
    """The fine networks of a field that the reference implementation trained; arrays float32, positions in units of its world.

    family: the configuration of `trunk`. network: the view-dependence network, None for a diffuse field.
    """

    step: int
    family: MlpModelConfig
    trunk: Trunk
    network: ViewNetwork | None
    box_scale: float = BOX_SCALE  # half the side of the cube round the origin that the reference bakes


def is_orbax(path: Path) -> bool:
    """Whether `path` is a folder that Orbax wrote: a checkpoint, one of its items, or a folder of checkpoints by their steps."""
    try:
        if not path.is_dir() or find_checkpoint(path) is not None:
            return False
        inside = [path, *(step for step in path.iterdir() if step.is_dir() and re.fullmatch(r"(checkpoint_)?\d+|default|state", step.name))]
        return any((folder / mark).is_file() for folder in inside for mark in ORBAX_MARKS)
    except OSError:
        return False  # no permission to list the folder


def find_checkpoint(path: Path) -> Path | None:
    """`path` itself if it is a file, or the checkpoint_<step> with the highest step in the folder `path`; None where there is none."""
    if not path.is_dir():
        return path if path.is_file() else None
    steps = {int(match[1]): p for p in path.iterdir() if p.is_file() and (match := re.fullmatch(r"checkpoint_(\d+)", p.name))}
    return steps[max(steps)] if steps else None


def read_reference_checkpoint(path: Path) -> ReferenceCheckpoint:
    """Read a checkpoint_<step> file, or the one with the highest step in a folder.

    Raises SnergError when there is none, when it is truncated, not written by flax or of another kind of NeRF, and when a tensor, which
    the message names, is not finite.
    """
    found = find_checkpoint(Path(path))
    if found is None and is_orbax(Path(path)):
        raise SnergError(
            f"{path} is an Orbax checkpoint, which is a folder of arrays that SNeRG does not read; restore it in Python with Orbax, write "
            "flax.serialization.msgpack_serialize({'params': params}) into a file checkpoint_1, and import that file."
        )
    if found is None:
        raise SnergError(f"There is no checkpoint at {path}; give a checkpoint_<step> file, or the folder that holds it.")
    with reading(found, "copy it again"):
        return _read(found)


def _read(found: Path) -> ReferenceCheckpoint:
    tree = _unpack(found)
    networks = _networks(tree, found)
    names = BAKED.get(tuple(sorted(map(str, networks))))
    if names is None:
        held = ", ".join(sorted(map(str, networks))[:8])[:100] or "nothing"
        raise SnergError(f"{found} holds {held}, not the networks of a deferred or diffuse NeRF; give a checkpoint of the SNeRG code.")
    if names[1] is None and _read_trunk(_layers(networks, "MLP_0", found), "MLP_0", found)[1]:
        raise SnergError(f"{found} was trained without fine samples, on features that no scene can hold; train it with fine samples.")
    layers = _layers(networks, names[0], found)
    family, features = _read_trunk(layers, names[0], found)
    if names[1] is None:
        return ReferenceCheckpoint(_step(tree, found), family, layers, None, _box_scale(found.parent))
    network = _view_network(_layers(networks, names[1], found), features, names[1], found)
    return ReferenceCheckpoint(_step(tree, found), family, _padded(layers), network, _box_scale(found.parent))


def _networks(tree: Any, path: Path) -> Mapping[Any, Any]:
    """The networks of a checkpoint by name, where flax.optim puts them or where a TrainState of newer flax does.

    Raises SnergError, which says what the file holds instead and what to write, where there are none.
    """
    for place in PLACES:
        inner = tree
        for name in place:
            inner = inner.get(name) if isinstance(inner, Mapping) else None
        if isinstance(inner, Mapping) and inner and (place or "MLP_0" in inner) and "params" not in inner:
            return inner
    held = ", ".join(sorted(map(str, tree))[:8])[:100] if isinstance(tree, Mapping) and tree else type(tree).__name__
    raise SnergError(
        f"{path} is not a checkpoint of the SNeRG code: it holds {held}, and no networks under 'optimizer' or 'params'; write "
        "flax.serialization.msgpack_serialize({'params': params}) with its MLP_0 to MLP_3, and import that file."
    )


def _box_scale(folder: Path) -> float:
    """snerg_box_scale of the configuration (*.yaml) in the checkpoint's folder; the reference's default where none states it."""
    for path in sorted((*folder.glob("*.yaml"), *folder.glob("*.yml"))):
        try:
            found = BOX_SCALE_LINE.search(path.read_bytes()) if path.is_file() and path.stat().st_size <= MAX_CONFIGURATION else None
            scale = float(found[1]) if found else 0.0
        except (OSError, ValueError):
            continue
        if 0 < scale <= FAR:
            return scale
    return BOX_SCALE


def reference_mlp(xnp: Any, checkpoint: ReferenceCheckpoint, points: Any, directions: Any) -> tuple[Any, Any, Any, Any]:
    """Evaluate the networks at positions [N, 3] and unit view directions [N, 3].

    Returns (density [N], RGB [N, 3], features [N, 4], residual [N, 3]). The residual is that of a ray whose only sample is this point. A
    diffuse field has no features, [N, 0], and its residual is 0.
    """
    family = checkpoint.family
    density, colour, features = activate(xnp, *trunk(xnp, checkpoint.trunk, points, family.degrees, family.skip))
    if checkpoint.network is None:
        return density, colour, features, xnp.zeros_like(colour)
    return density, colour, features, view_residual(xnp, checkpoint.network, colour, features, directions)


def field_of(checkpoint: ReferenceCheckpoint, source: str) -> Field:
    """The field of a checkpoint, to be baked. Field coordinates are world coordinates, and the domain is [-box_scale, box_scale]^3.

    The field has no cameras and no dataset, because a checkpoint contains neither: a bake can use neither visibility culling nor
    fine-tuning.
    """
    reach = np.full(3, checkpoint.box_scale)
    return Field(
        family=checkpoint.family,
        params=checkpoint.trunk,
        network=checkpoint.network,
        domain=Domain(np.zeros(3), 1.0, -reach, reach),
        occupancy=None,
        spacing=2 * checkpoint.box_scale / SAMPLES_ACROSS,
        about={"source": source, "family": type(checkpoint.family).__name__, "steps": checkpoint.step},
        view="deferred" if checkpoint.network else "diffuse",
    )


def _unpack(path: Path) -> Any:
    """The file's tree, in which arrays stay `_Packed` until they are decoded: at most twice the file's size is in memory."""
    import msgpack

    check_file(path, MAX_BYTES)
    data = path.read_bytes()
    for start, what in OTHER_FILES:
        if re.match(start, data):
            raise SnergError(f"{path} is {what}, not a checkpoint of the SNeRG code; give a checkpoint_<step> that flax wrote.")
    try:
        return msgpack.unpackb(data, ext_hook=_Packed, strict_map_key=False, **LIMITS)
    except Exception as error:  # msgpack raises half a dozen kinds, ValueError to its own StackError
        why = str(error) or type(error).__name__
        raise SnergError(f"{path} is not a checkpoint of the SNeRG code, or is cut short ({why}); copy it again.") from error


@dataclass(frozen=True)
class _Packed:
    """An extension value of the file, not decoded or validated yet."""

    code: int
    data: bytes

    def array(self) -> NDArray[Any]:
        """Decode an array or a scalar, of any shape. Raises ValueError when its type, shape and size are inconsistent."""
        import msgpack

        if self.code not in (NDARRAY, SCALAR):
            raise ValueError(f"extension type {self.code}")
        shape, kind, raw = msgpack.unpackb(self.data, raw=True, **LIMITS)
        name = kind.decode("ascii", "replace")
        if name not in KINDS:
            raise ValueError(f"values of type {name[:20]}")
        values = np.frombuffer(raw, np.dtype(name))
        if not all(isinstance(n, int) and n >= 0 for n in shape):
            raise ValueError("a shape that is none")
        return values.reshape(shape)


def _array(value: Any) -> NDArray[Any]:
    """An array, whole or in chunks (flax splits what is over 2^30 bytes). Raises ValueError."""
    if isinstance(value, Mapping) and "__msgpack_chunked_array__" in value:
        chunks = [_array(chunk) for chunk in _listed(value["chunks"])]
        return np.asarray(np.concatenate([chunk.reshape(-1) for chunk in chunks]).reshape([int(n) for n in _listed(value["shape"])]))
    if not isinstance(value, _Packed):
        raise ValueError(f"{type(value).__name__} where an array should be")
    return value.array()


def _listed(value: Any) -> list[Any]:
    """flax writes a tuple as {"0": ..., "1": ...}."""
    return [value[str(i)] for i in range(len(value))] if isinstance(value, Mapping) else list(value)


def _mapping(value: Any, name: str, path: Path) -> Mapping[Any, Any]:
    inner = value.get(name) if isinstance(value, Mapping) else None
    if not isinstance(inner, Mapping):
        raise SnergError(f"{path} is not a checkpoint of the SNeRG code: it has no {name}.")
    return inner


def _step(tree: Mapping[Any, Any], path: Path) -> int:
    """The number of training steps, 0 where the checkpoint has none."""
    state = tree["optimizer"].get("state") if isinstance(tree.get("optimizer"), Mapping) else tree
    step = state.get("step", 0) if isinstance(state, Mapping) else 0
    try:
        return int(step if isinstance(step, int) else _array(step))
    except Exception as error:
        raise SnergError(f"{path} has a damaged step ({error}); copy it again.") from error


def _layers(networks: Mapping[Any, Any], network: str, path: Path) -> Trunk:
    """Dense_0, Dense_1, ... of a network, float32; the error names the tensor (hard case 59)."""
    layers = []
    for index in range(len(_mapping(networks, network, path))):
        name = f"{network}/Dense_{index}"
        try:
            packed = networks[network][f"Dense_{index}"]
            layer = Dense(*(np.array(_array(packed[part]), np.float32) for part in ("kernel", "bias")))
        except Exception as error:  # a damaged file can put anything anywhere, inner msgpack errors included
            raise SnergError(f"{path} has no sound {name} ({type(error).__name__}: {str(error)[:100]}); copy it again.") from error
        if layer.kernel.ndim != 2 or layer.bias.shape != layer.kernel.shape[1:] or 0 in layer.kernel.shape:
            _misshapen(path, name, f"{layer.kernel.shape} and {layer.bias.shape}")
        for part, value in layer._asdict().items():
            if not np.isfinite(value).all():
                raise SnergError(
                    f"{path} has values in {name}/{part} that are not finite; its training diverged: use an earlier checkpoint."
                )
        layers.append(layer)
    return tuple(layers)


def _read_trunk(layers: Trunk, name: str, path: Path) -> tuple[MlpModelConfig, int]:
    """(configuration of a trunk, number of its features), from the shapes of its tensors."""
    shapes = [layer.kernel.shape for layer in layers]
    if len(shapes) < 3:
        _misshapen(path, name, f"{len(shapes)} layers")
    (encoded, width), depth = shapes[0], len(shapes) - 2
    if shapes[-2][1] != 1 and any(columns == 1 for _, columns in shapes[:-2]):
        raise SnergError(
            f"{path} is of a NeRF whose colour depends on the direction at every sample, as JAXNeRF and mip-NeRF train it; "
            "only deferred and diffuse ones can be imported."
        )
    if encoded < 3 or (encoded - 3) % 6:
        _misshapen(path, f"{name}/Dense_0", f"{shapes[0]}, whose rows are no positional encoding")
    fed = [i for i in range(1, depth) if shapes[i + 1][0] == width + encoded]  # after these layers the encoding is fed in again
    skip = fed[0] if fed else depth
    outputs = shapes[-1][1]
    after = [width + encoded * (i > 0 and i % skip == 0) for i in range(depth)]
    expected = [(rows, width) for rows in (encoded, *after[:-1])] + [(after[-1], 1), (after[-1], outputs)]
    for i, (shape, wanted) in enumerate(zip(shapes, expected, strict=True)):
        if shape != wanted:
            _misshapen(path, f"{name}/Dense_{i}", f"{shape}, not {wanted}")
    if not 3 <= outputs <= 3 + FEATURES:
        _misshapen(path, f"{name}/Dense_{depth + 1}", f"{shapes[-1]}, which is not RGB and up to {FEATURES} features")
    return MlpModelConfig(width=width, depth=depth, skip=skip, degrees=(encoded - 3) // 6, density="relu"), outputs - 3


def _padded(layers: Trunk) -> Trunk:
    """The trunk padded to FEATURES features. The padded view network ignores the added ones (its weights for them are 0)."""
    head = layers[-1]
    more = 3 + FEATURES - head.bias.size
    return (*layers[:-1], Dense(np.pad(head.kernel, ((0, 0), (0, more))), np.pad(head.bias, (0, more))))


def _view_network(layers: Trunk, features: int, name: str, path: Path) -> ViewNetwork:
    """A view-dependence network of the size that scenes have, 34 -> 16 -> 16 -> 3, equivalent to one of that size or smaller.

    Narrower layers are padded with zeros. A missing layer becomes the identity, which is exact because a ReLU precedes it.
    The reference's view network also outputs a density, which is not used.
    """
    hidden, head = list(layers[:-2]), layers[-1]
    shapes = [layer.kernel.shape for layer in (*hidden, head)]
    (rows, width), extra = shapes[0], 3 + features
    degrees = (rows - extra - 3) // 6
    wanted = [(3 + 6 * degrees + extra, width), *[(width, width)] * (len(hidden) - 1), (width, 3)]
    if shapes != wanted or not (len(hidden) in (1, 2) and width <= SHAPES[1][0] and 0 <= degrees <= VIEW_DEGREES):
        _misshapen(
            path, name, f"{' -> '.join(map(str, (rows, *(columns for _, columns in shapes))))}, where 34 -> 16 -> 16 -> 3 is the most"
        )
    if len(hidden) == 1:
        hidden.append(Dense(np.eye(width, dtype=np.float32), np.zeros(width, np.float32)))
    network = ViewNetwork(*(np.zeros(shape, np.float32) for shape in SHAPES))
    network.weights_0[_view_rows(degrees, features), :width], network.bias_0[:width] = hidden[0]
    network.weights_1[:width, :width], network.bias_1[:width] = hidden[1]
    network.weights_2[:width], network.bias_2[:] = head
    return network


def _view_rows(degrees: int, features: int) -> Sequence[int]:
    """The indices, among the 34 inputs of a scene's view network, of the inputs of a network with fewer degrees or features, in order."""
    cosines = 3 + 3 * VIEW_DEGREES
    colour = cosines + 3 * VIEW_DEGREES
    return [*range(3 + 3 * degrees), *range(cosines, cosines + 3 * degrees), *range(colour, colour + 3 + features)]


def _misshapen(path: Path, name: str, what: object) -> NoReturn:
    raise SnergError(f"{path} is not a checkpoint that SNeRG can take: {name} is {what}.")
