"""A field on disk: a folder with field.npz, which holds arrays and one JSON text, and no pickles."""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..capture.ndc import Ndc
from ..errors import SnergError
from ..files import MARK, json_bytes, write_arrays, write_bytes
from .encoding import HashGrid
from .field import Field
from .networks import Family, HashFamily, MlpFamily, ViewNetwork
from .positional import Dense
from .sampling import Domain

FILE = "field.npz"
FORMAT = "snerg-field"
VERSION = 3
MAX_BYTES = 2**31


def write_field(field: Field, folder: Path, state: dict[str, np.ndarray] | None = None) -> None:
    """Write a field, whole or not at all; `state` is what training needs to go on. Raises SnergError naming a bad array."""
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
        "family": {"kind": type(field.family).__name__, **asdict(field.family)},
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
    """Whether a folder looks like one that `write_field` wrote."""
    return (path / FILE).is_file()


def read_field(path: Path) -> Field:
    """Read a field's folder. Raises SnergError when it is missing, cut short or not a field."""
    return read_field_and_state(path)[0]


def read_field_and_state(path: Path) -> tuple[Field, dict[str, np.ndarray]]:
    """A field, and what `write_field` was given as its training state."""
    file = path / FILE if path.is_dir() else path
    if not file.is_file():
        raise SnergError(f"There is no field at {path}; train one with 'snerg train', or import one with 'snerg import'.")
    try:
        if file.stat().st_size > MAX_BYTES:
            raise SnergError(f"{file} is larger than {MAX_BYTES >> 30} GiB; it cannot be a field.")
        # Opened here, because NumPy leaves a file that it cannot read open.
        with open(file, "rb") as handle, np.load(handle, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        about = json.loads(arrays.pop("json").tobytes())
        if about["format"] != FORMAT or about["version"] != VERSION:
            raise SnergError(f"{file} has format {about['format']} {about['version']}; this SNeRG reads {FORMAT} {VERSION}: update it.")
        return _field(arrays, about), {k.removeprefix("state."): v for k, v in arrays.items() if k.startswith("state.")}
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise SnergError(f"{file} is damaged or cut short ({type(error).__name__}: {error}); train it again or copy it again.") from error


def _field(arrays: dict[str, np.ndarray], about: dict[str, Any]) -> Field:
    family = read_family(about["family"])
    view = {k.removeprefix("view."): v for k, v in arrays.items() if k.startswith("view.")}
    return Field(
        family=family,
        params=unflatten({k.removeprefix("params."): v for k, v in arrays.items() if k.startswith("params.")}, family),
        network=ViewNetwork(**view) if view else None,
        domain=Domain(arrays["domain.centre"], float(about["scale"]), arrays["domain.low"], arrays["domain.high"]),
        occupancy=arrays.get("occupancy"),
        spacing=float(about["spacing"]),
        cameras=tuple(Camera.from_json(camera) for camera in about["cameras"]),
        dataset=str(about["dataset"]),
        about=dict(about["about"]),
        ndc=None if about["ndc"] is None else Ndc.from_json(about["ndc"]),
        view=str(about["view"]),
    )


def read_family(value: dict[str, Any]) -> Family:
    """From asdict of a family and its class's name."""
    value = dict(value)
    kind = value.pop("kind")
    if kind == HashFamily.__name__:
        return HashFamily(**{**value, "grid": HashGrid(**value["grid"])})
    if kind == MlpFamily.__name__:
        return MlpFamily(**value)
    raise ValueError(f"family {kind}")


def flatten(params: Any) -> dict[str, np.ndarray]:
    """A field's parameters as named arrays: a dict of them, or the layers of a trunk."""
    if isinstance(params, dict):
        return {k: np.asarray(v) for k, v in params.items()}
    return {f"{i:02d}.{k}": np.asarray(v) for i, layer in enumerate(params) for k, v in layer._asdict().items()}


def unflatten(arrays: dict[str, np.ndarray], family: Family) -> Any:
    """Undo `flatten`."""
    if isinstance(family, HashFamily):
        return arrays
    return tuple(Dense(arrays[f"{i:02d}.kernel"], arrays[f"{i:02d}.bias"]) for i in range(len(arrays) // 2))
