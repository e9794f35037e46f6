"""Field probes as files, so that one probe of a field serves all estimates of it. Read without JAX."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.files import write_arrays
from ..io.guard import read_arrays, reading
from ..io.schema import number, numbers, record
from ..nerf.checkpoint import FILE
from ..nerf.field import Field
from ..nerf.reference_checkpoint import find_checkpoint
from .field_probe import FieldProbe, Rates, coarse

VERSION = 2
ARRAYS = ("points", "inside", "voxels", "held", "kept", "samples", "kept_bytes")
FLAGS = ("inside", "held", "kept")  # the arrays of booleans
RATE_KEYS = {  # names of the rates in files, which have been the same since the first version
    "compile": "start",
    "block_voxel": "test",
    "query": "query",
    "visibility_view": "eye",
    "visibility_ray": "look",
    "sample": "fill",
    "kept_voxel": "keep",
    "preview_view": "view",
    "preview_ray": "ray",
    "acceleration_block": "table",
    "preview_samples": "met",
    "preview_growth": "growth",
    "visibility_samples": "seen_met",
    "visibility_growth": "seen_growth",
}
MAX_BYTES = 2**28  # of a file that is read; a probe takes about 1 MB


def stamp(source: Path) -> str:
    """What identifies the file of a field or checkpoint and this machine; it changes when the file is written. Raises OSError."""
    file = source / FILE if (source / FILE).is_file() else find_checkpoint(source) or source
    status = file.stat()
    return f"{status.st_mtime_ns} {status.st_size} {platform.node()} {os.cpu_count()}"


def write_field_probe(path: Path, probe: FieldProbe, mark: str) -> None:
    """Write the probe of the field with the stamp `mark`, whole or not at all. Raises SnergError where it cannot be written."""
    rates = {RATE_KEYS[name]: value for name, value in asdict(probe.rates).items()}
    about = {"survey": VERSION, "field": mark, "rates": rates, "share": probe.share}
    about |= {"pilot": probe.pilot, "seconds": probe.seconds, "size": probe.filled[1]}
    arrays = {name: np.asarray(getattr(probe, name)) for name in ARRAYS} | {"filled": probe.filled[0]}
    write_arrays(path, arrays | {"about": np.array(json.dumps(about))})


def check_field_probe(path: Path) -> None:
    """Raise SnergError when `path` holds something other than a field probe, which `write_field_probe` would overwrite."""
    try:
        if not path.exists() or "survey" in open_file(path)[0]:
            return
    except SnergError:
        pass
    raise SnergError(f"{path} is there already, and is not a field probe; choose another file, or delete it.")


def open_file(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The JSON value and the arrays (of any shape, see `checked`) of a file. Raises SnergError where it cannot be read."""
    with reading(path, "delete it"):
        arrays = read_arrays(path, MAX_BYTES)
        return record(json.loads(str(arrays.pop("about"))), "about"), arrays


def checked(about: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """The attributes of a FieldProbe, apart from its fields, by name: arrays [M, 3], [M], [S], [S, M] as FieldProbe documents.

    Raises ValueError, KeyError or TypeError on a file that `write_field_probe` did not write.
    """
    m, s, n = len(arrays["points"]), len(arrays["voxels"]), len(arrays["filled"])
    shapes = {
        "points": (m, 3),
        "inside": (m,),
        "voxels": (s,),
        "held": (s, m),
        "kept": (s, m),
        "samples": (s,),
        "kept_bytes": (s,),
        "filled": (n, 3),
    }
    for name, shape in shapes.items():
        array = arrays[name]
        numbers(array.astype(np.uint8) if array.dtype == bool else array, name, shape)
        if (array.dtype == bool) != (name in FLAGS):
            raise ValueError(f"{name} is {array.dtype}")
    if not s or not (arrays["voxels"] > 0).all() or not (arrays["samples"] >= 1).all():
        raise ValueError("it has no voxel sizes")
    values: dict[str, Any] = {name: number(about[name], name, 0) for name in ("share", "pilot", "seconds")}
    rates = record(about["rates"], "rates")
    values["rates"] = Rates(**{name: number(rates[key], key) for name, key in RATE_KEYS.items()})
    values["samples"] = tuple(int(count) for count in arrays["samples"])
    values["filled"] = arrays["filled"], number(about["size"], "size", 0)
    return {name: arrays[name] for name in ARRAYS} | values


def read_field_probe(path: Path, mark: str, field: Callable[[], Field]) -> FieldProbe | None:
    """The probe of the field with the stamp `mark`. None where there is no file, where it belongs to another field or machine, or
    where it cannot be read: a new probe takes seconds. field: reads the field; its errors are raised.
    """
    try:
        about, arrays = open_file(path)
        if about.get("survey") != VERSION or about.get("field") != mark:
            return None
        with reading(path, "delete it"):
            values = checked(about, arrays)
    except SnergError:
        return None
    source = field()
    return FieldProbe(field=source, coarse=coarse(source), **values)
