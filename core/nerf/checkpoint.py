"""Writes and reads a field's folder. Its field.npz holds arrays and one JSON text; pickled data is refused."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.camera import Camera
from ..geometry.ndc import Ndc
from ..io.about import check_about_field
from ..io.files import MARK, write_arrays, write_bytes
from ..io.guard import read_arrays, reading
from ..io.json_files import json_bytes
from ..io.schema import numbers, positive, record, shown, text, whole
from .field import Field
from .hash_grid import HashGrid
from .mlp import FEATURES, Dense, layer_shapes
from .model import ENCODED_VIEW, SHAPES, VIEWS, HashModelConfig, MlpModelConfig, ModelConfig, ViewNetwork
from .sampling import CELLS, Domain

FILE = "field.npz"
FORMAT = "snerg-field"
VERSION = 3
FAMILIES: dict[type, str] = {HashModelConfig: "HashFamily", MlpModelConfig: "MlpFamily"}  # as files name them
MAX_BYTES = 2**31
LARGEST = 1e9  # bound on a network's weights: products of several layers stay finite in float32
MAX_WIDTH = 2**13
GRID_LIMITS = {"levels": 32, "coarsest": 2**14, "finest": 2**14, "features": 16, "log2_size": 28}
MLP_LIMITS = {"width": (1, MAX_WIDTH), "depth": (1, 64), "skip": (1, 2**16), "degrees": (0, 32)}


def write_field(field: Field, folder: Path, state: dict[str, NDArray[Any]] | None = None) -> None:
    """Write a field, whole or not at all. state: what training needs to continue, named arrays of any shape.

    Raises SnergError that names an array with values that are not finite, or when the folder cannot be written.
    """
    arrays = {f"params.{name}": array for name, array in flatten(field.params).items()}
    if field.network is not None:
        arrays |= {f"view.{k}": np.asarray(v) for k, v in field.network._asdict().items()}
    arrays |= {"domain.centre": field.domain.centre, "domain.low": field.domain.low, "domain.high": field.domain.high}
    if field.occupancy is not None:
        arrays["occupancy"] = field.occupancy
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise SnergError(f"The field's {name} holds values that are not finite; nothing was written.")
    about = {
        "format": FORMAT,
        "version": VERSION,
        "family": {"kind": FAMILIES[type(field.family)], **asdict(field.family)},
        "scale": field.domain.scale,
        "spacing": field.spacing,
        "ndc": None if field.ndc is None else field.ndc.to_json(),
        "dataset": field.dataset,
        "view": field.view,
        "cameras": [camera.to_json() for camera in field.cameras],
        "about": field.about,
    }
    arrays["json"] = np.frombuffer(json_bytes(about), np.uint8)
    arrays |= {f"state.{k}": v for k, v in (state or {}).items()}
    write_bytes(folder / MARK, b"Written by SNeRG for Blender.\n")
    write_arrays(folder / FILE, arrays)


def is_field(path: Path) -> bool:
    """Whether the folder contains a field.npz; its contents are not checked."""
    return (path / FILE).is_file()


def read_field(path: Path) -> Field:
    """Read a field's folder. Raises SnergError when it is missing, cut short or not a field."""
    return read_field_and_state(path)[0]


def read_field_and_state(path: Path) -> tuple[Field, dict[str, NDArray[Any]]]:
    """Read a field and its training state, named arrays of any shape as `write_field` got them. Raises SnergError as `read_field`."""
    file = path / FILE if path.is_dir() else path
    if not file.is_file():
        raise SnergError(f"There is no field at {path}; train one with 'snerg train', or import one with 'snerg import'.")
    with reading(file, "train it again or copy it again"):
        arrays = read_arrays(file, MAX_BYTES)
        about = record(json.loads(arrays.pop("json").tobytes()), "json")
        if about["format"] != FORMAT or about["version"] != VERSION:
            raise SnergError(f"{file} has format {about['format']} {about['version']}; this SNeRG reads {FORMAT} {VERSION}: update it.")
        return _field(arrays, about), {k.removeprefix("state."): v for k, v in arrays.items() if k.startswith("state.")}


def _field(arrays: dict[str, NDArray[Any]], about: dict[str, Any]) -> Field:
    """Raises ValueError, or anything else, where the arrays or the JSON value are not what `write_field` writes."""
    family, kind = read_family(about["family"]), about["view"]
    if kind not in VIEWS:
        raise ValueError(f"view is {shown(kind)}")
    params = {k.removeprefix("params."): v for k, v in arrays.items() if k.startswith("params.")}
    check_params(params, family, kind)
    view = {k.removeprefix("view."): v for k, v in arrays.items() if k.startswith("view.")}
    return Field(
        family=family,
        params=unflatten(params, family),
        network=_network(view) if view or kind in ("deferred", "tiny") else None,
        domain=_domain(arrays, about),
        occupancy=_occupancy(arrays.get("occupancy")),
        spacing=positive(about["spacing"], "spacing"),
        cameras=tuple(Camera.from_json(camera) for camera in about["cameras"]),
        dataset=text(about["dataset"], "dataset"),
        about=check_about_field(about["about"]),
        ndc=None if about["ndc"] is None else Ndc.from_json(about["ndc"]),
        view=kind,
    )


def _network(arrays: dict[str, NDArray[Any]]) -> ViewNetwork:
    return ViewNetwork(
        *(numbers(arrays[name], name, shape, LARGEST).astype(np.float32) for name, shape in zip(ViewNetwork._fields, SHAPES, strict=True))
    )


def _domain(arrays: dict[str, NDArray[Any]], about: dict[str, Any]) -> Domain:
    centre, low, high = (numbers(arrays[f"domain.{name}"], f"domain.{name}", (3,)) for name in ("centre", "low", "high"))
    if not (low < high).all():
        raise ValueError("the domain's corners are not in order")
    return Domain(centre, positive(about["scale"], "scale"), low, high)


def _occupancy(cells: NDArray[Any] | None) -> NDArray[Any] | None:
    if cells is not None and (cells.shape != (CELLS**3,) or cells.dtype != bool):
        raise ValueError(f"occupancy is {cells.dtype} {cells.shape}; it must be bool ({CELLS**3},)")
    return cells


def check_params(params: dict[str, NDArray[Any]], family: ModelConfig, view: str) -> None:
    """Raise ValueError unless a field's parameters are finite and have the names and shapes of `param_shapes`; arrays of any shape."""
    wanted = param_shapes(family, view, params)
    if params.keys() != wanted.keys():
        raise ValueError(f"the network has arrays {sorted(params)[:4]} ..., not {sorted(wanted)[:4]} ...")
    for name, array in params.items():
        numbers(array, name, wanted[name], LARGEST)
        if array.dtype.kind != "f":
            raise ValueError(f"{name} is {array.dtype}")


def param_shapes(family: ModelConfig, view: str, params: dict[str, NDArray[Any]]) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the arrays that `flatten` returns for a field of this family and view dependence.

    params: the field's arrays of any shape; their last layer shows whether a diffuse field has features.
    """
    last = params.get("bias_1" if isinstance(family, HashModelConfig) else f"{family.depth + 1:02d}.bias")
    outputs = {"sample": family.width}.get(view, 3 + FEATURES)
    if view == "diffuse" and last is not None and last.size < 1 + outputs:
        outputs = 3
    layers: list[tuple[int, int]]
    if isinstance(family, HashModelConfig):
        layers = [(family.grid.levels * family.grid.features, family.width), (family.width, 1 + outputs)]
    else:
        layers = list(layer_shapes(family.width, family.depth, family.degrees, family.skip, outputs))
    if view == "sample":
        half = max(family.width // 2, 1)
        layers += [(family.width + ENCODED_VIEW, half), (half, 3)]
    parts = ("weights_{}", "bias_{}") if isinstance(family, HashModelConfig) else ("{:02d}.kernel", "{:02d}.bias")
    shapes: dict[str, tuple[int, ...]] = {}
    for i, (rows, columns) in enumerate(layers):
        shapes |= {parts[0].format(i): (rows, columns), parts[1].format(i): (columns,)}
    if isinstance(family, HashModelConfig):
        shapes |= {f"table_{i}": (size * family.grid.features,) for i, size in enumerate(family.grid.sizes.tolist())}
    return shapes


def read_family(value: dict[str, Any]) -> ModelConfig:
    """A model's configuration from its JSON value: the fields of the class, and a name of FAMILIES as "kind".

    Raises ValueError or KeyError when the value is anything else.
    """
    value = dict(value)
    kind = value.pop("kind")
    if kind == FAMILIES[HashModelConfig]:
        grid = {name: whole(n, name, 1, GRID_LIMITS[name]) for name, n in record(value["grid"], "grid").items()}
        return HashModelConfig(HashGrid(**grid), whole(value["width"], "width", 1, MAX_WIDTH))
    if kind == FAMILIES[MlpModelConfig]:
        if value["density"] not in ("softplus", "relu"):
            raise ValueError(f"density is {shown(value['density'])}")
        sizes = {name: whole(value[name], name, low, high) for name, (low, high) in MLP_LIMITS.items()}
        return MlpModelConfig(**sizes, density=value["density"])
    raise ValueError(f"family {shown(kind)}")


def flatten(params: Any) -> dict[str, NDArray[Any]]:
    """A field's parameters as named arrays of any shape. params: a dict of arrays (hash grid) or a tuple of layers (MLP)."""
    if isinstance(params, dict):
        return {k: np.asarray(v) for k, v in params.items()}
    return {f"{i:02d}.{k}": np.asarray(v) for i, layer in enumerate(params) for k, v in layer._asdict().items()}


def unflatten(arrays: dict[str, NDArray[Any]], family: ModelConfig) -> Any:
    """The inverse of `flatten`: a field's parameters from named arrays of any shape."""
    if isinstance(family, HashModelConfig):
        return arrays
    return tuple(Dense(arrays[f"{i:02d}.kernel"], arrays[f"{i:02d}.bias"]) for i in range(len(arrays) // 2))
